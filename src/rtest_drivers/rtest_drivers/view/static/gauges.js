// The gauges' values in their ranges, and the bar that shows a value in a range.
import {cell} from './connection.js';
import {WORDS, byId, element, number, rows, set} from './dom.js';

export function newBar() {
  const bar = element('div', 'bar');
  bar.append(element('div', 'fill'), element('div', 'zero'), element('div', 'needle'));
  return bar;
}

export function drawBar(bar, value, range) {
  const [fill, zero, needle] = bar.children;
  const place = (v) => 100 * Math.min(1, Math.max(0, (v - range[0]) / (range[1] - range[0])));
  const middle = place(0), at = value === null ? middle : place(value);
  fill.style.left = `${Math.min(middle, at)}%`;
  fill.style.width = `${Math.abs(at - middle)}%`;
  zero.style.left = `${middle}%`;
  needle.style.left = `${at}%`;
  needle.hidden = value === null;
}

// Where a range is not told: the largest value of the last minute, rounded up [µm].
function scaleOf(index) {
  let most = 10;
  for (const row of cell.strip) {
    const span = row.spans[index];
    if (span) most = Math.max(most, -span[0], span[1]);
  }
  const power = 10 ** Math.floor(Math.log10(most));
  const end = [1, 2, 5, 10].find((step) => step * power >= most) * power;
  return [-end, end];
}

export function drawGauges() {
  const gauges = cell.live.gauges;
  const made = rows(byId('gauges'), gauges.length, () => {
    const row = element('div', 'gauge'), middle = element('div'), ends = element('div', 'ends');
    ends.append(element('span'), element('span'), element('span'));
    middle.append(newBar(), ends);
    const value = element('div', 'value');
    value.append(element('span', 'figure'), element('span', 'unit', ' µm'));
    row.append(element('b'), middle, value, element('span'));
    return row;
  });
  gauges.forEach((one, index) => {
    const [name, middle, value, state] = made[index].children;
    const range = one.range || scaleOf(index);
    set(name, one.name);
    set(value.firstChild, number(one.value, 2),
      one.text === 'old value' ? 'figure old' : 'figure');
    set(state, one.level === 'ok' ? 'OK' : `${WORDS[one.level]}: ${one.text}`,
      `badge ${one.level}`);
    made[index].dataset.level = one.level;
    drawBar(middle.firstChild, one.value, range);
    const [low, note, high] = middle.lastChild.children;
    set(low, number(range[0], 0));
    set(note, one.range ? 'range in µm' : 'range not told; scale in µm');
    set(high, number(range[1], 0));
  });
}
