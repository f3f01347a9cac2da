// The map of poses of a cycle: which are measured, which are missing and why.
import {cell} from './connection.js';
import {byId, element, rows, set} from './dom.js';

const WORDS = {open: 'to come', reached: 'reached', done: 'measured', missing: 'missing'};
const SIGNS = {open: '·', reached: '○', done: '✓', missing: '✗'};

// A cycle that a person has chosen, null for the last; a pose of it, null for none.
let shownCycle = null, shownPose = null;

// Another session has begun.
export function forgetCycle() {
  shownCycle = null;
}

export function drawPoses() {
  const names = Object.keys(cell.parts).filter((name) => name.startsWith('cycle:'))
    .sort((a, b) => Number(a.slice(6)) - Number(b.slice(6)));
  const last = names[names.length - 1];
  if (!last) { byId('cycles').replaceChildren(); byId('poses').replaceChildren(); return; }
  // The last one is followed unless a person has chosen another.
  const current = shownCycle && cell.parts[shownCycle] ? shownCycle : last;
  const made = rows(byId('cycles'), names.length, () => element('button'));
  names.forEach((name, index) => {
    const one = cell.parts[name];
    const label = `${one.cycle}${one.finished ? one.missing ? ' ⚠' : ' ✓' : ' …'}`;
    set(made[index], label, name === current ? 'chosen' : '');
    made[index].onclick = () => {
      shownCycle = name === last ? null : name;
      shownPose = null;
      drawPoses();
    };
  });
  const one = cell.parts[current], all = one.states.length;
  set(byId('poses-title'), `${one.kind}, sphere ${one.setup}: ` + (one.finished ?
    `${one.done} of ${all} measured` + (one.missing ? `, ${one.missing} MISSING` : '') :
    `${one.reached} of ${all} reached, measured or not is known at its end`));
  drawGrid(byId('poses'), one, current);
  const reasons = Object.entries(one.reasons).filter(([index]) => one.states[index] === 'missing');
  const list = rows(byId('missing'), reasons.length, () => element('li'));
  reasons.forEach(([index, text], place) => {
    set(list[place], `Pose ${index} (${one.names[index]}): ${text}`);
  });
  if (shownPose !== null && one.names[shownPose]) showPose(one, shownPose);
  else set(byId('pose-name'), 'Tap a pose for its position.');
}

function drawGrid(grid, one, name) {
  if (grid.dataset.cycle !== name || grid.dataset.count !== String(one.states.length)) {
    grid.dataset.cycle = name;
    grid.dataset.count = one.states.length;
    makeGrid(grid, one);
  }
  for (const button of grid.querySelectorAll('button')) {
    const state = one.states[button.dataset.pose];
    set(button, SIGNS[state], state);
    button.setAttribute('aria-label', `${one.names[button.dataset.pose]}: ${WORDS[state]}`);
  }
}

function makeGrid(grid, one) {
  grid.replaceChildren();
  const wide = Math.max(...one.places.map((place) => place[1])) + 1;
  const labelled = one.rows.length > 0;
  // Where there are labels, no column is narrower than its own.
  grid.style.gridTemplateColumns = labelled ?
    `max-content repeat(${wide}, minmax(max-content, 1fr))` : `repeat(${wide}, minmax(26px, 1fr))`;
  if (labelled) {
    grid.append(element('span'));
    for (const text of one.columns) grid.append(element('span', '', text));
  }
  // Several poses of one place stand beside each other in one cell.
  const cells = {};
  one.places.forEach(([row, column], index) => {
    const key = `${row},${column}`;
    if (!cells[key]) {
      cells[key] = element('div');
      cells[key].style.display = 'flex';
      cells[key].style.gridRow = row + (labelled ? 2 : 1);
      cells[key].style.gridColumn = column + (labelled ? 2 : 1);
      grid.append(cells[key]);
    }
    const button = element('button');
    button.type = 'button';
    button.dataset.pose = index;
    button.style.flex = '1';
    button.onclick = () => { shownPose = index; drawPoses(); };
    cells[key].append(button);
  });
  one.rows.forEach((text, row) => {
    const label = element('span', '', text);
    label.style.gridRow = row + 2;
    label.style.gridColumn = 1;
    grid.append(label);
  });
}

function showPose(one, index) {
  const state = WORDS[one.states[index]];
  const why = one.reasons[index] ? `: ${one.reasons[index]}` : '';
  set(byId('pose-name'), `Pose ${index}, ${one.names[index]}: ${state}${why}`);
}
