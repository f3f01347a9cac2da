// Elements of the page, and numbers as a person writes them.

export const byId = (id) => document.getElementById(id);

// Levels of devices, nodes and gauges as the server names them.
export const WORDS = {ok: 'OK', warn: 'WARNING', error: 'ERROR', idle: 'IDLE'};

export function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

// Touches only what has changed: most of ten records a second is as it was.
export function set(node, text, className) {
  if (node.textContent !== text) node.textContent = text;
  if (className !== undefined && node.className !== className) node.className = className;
}

// A list of elements that is made anew only when its length changes.
export function rows(parent, count, make) {
  while (parent.children.length > count) parent.lastChild.remove();
  while (parent.children.length < count) parent.append(make(parent.children.length));
  return [...parent.children];
}

export function number(value, digits) {
  if (value === null || value === undefined) return '–';
  const text = value.toFixed(digits);
  return minus(Number(text) === 0 ? text.replace('-', '') : text);
}

// A minus sign in place of the hyphen.
export function minus(value) {
  return String(value).replace('-', '−');
}

// Buttons of which one is chosen; `then` gets what it shows.
export function choice(id, then) {
  const buttons = [...byId(id).children];
  for (const button of buttons) {
    button.onclick = () => {
      for (const other of buttons) other.classList.toggle('chosen', other === button);
      then(button.dataset.show);
    };
  }
}
