// Canvas: sharp on every screen, round steps, a frame with numbers, lines told by colour and dash.
import {byId, element, minus, rows, set} from './dom.js';

export const INK = '#15202b', QUIET = '#56616c';
// After Okabe and Ito (2008), for the colour-blind; dark enough to write a name in.
export const COLOURS = ['#0072B2', '#b34f00', '#007a5a', '#a0457f', '#7a6200', '#4b3bb0'];
// So that no line is told by its colour alone.
export const DASHES = [[], [7, 4], [2, 3], [11, 3, 2, 3], [14, 5], [7, 3, 2, 3, 2, 3], [4, 2]];

// A cleared canvas as wide as it is shown, `height` [px]; returns its context and width [px].
export function prepared(canvas, height) {
  const wide = canvas.clientWidth || 300, scale = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(wide * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(wide * scale);
    canvas.height = Math.round(height * scale);
    canvas.style.height = `${height}px`;
  }
  const context = canvas.getContext('2d');
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, wide, height);
  context.font = '14px system-ui, sans-serif';
  context.setLineDash([]);
  context.lineWidth = 1;
  return [context, wide];
}

// Round steps that divide a span in about so many parts.
export function steps(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((one) => one * power >= raw) * power;
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high + 1e-9 * step; n += 1) {
    found.push(Number((n * step).toPrecision(12)));
  }
  return found;
}

// Smallest and largest value with some room; null where there is no value.
export function limits(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value === null || Number.isNaN(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (low > high) return null;
  const room = Math.max(0.08 * (high - low), 0.05);
  return [low - room, high + room];
}

// Lines and numbers of a scale; returns where a value stands [px].
export function frame(context, box, low, high, unit) {
  const at = (value) => box.bottom - (value - low) / (high - low) * (box.bottom - box.top);
  context.fillStyle = QUIET;
  context.textAlign = 'right';
  context.textBaseline = 'middle';
  // One number alone is no scale.
  const few = steps(low, high, 4);
  for (const value of few.length > 1 ? few : steps(low, high, 8)) {
    context.strokeStyle = value === 0 ? '#8a949e' : '#dde2e7';
    context.beginPath();
    context.moveTo(box.left, at(value));
    context.lineTo(box.right, at(value));
    context.stroke();
    context.fillText(minus(value), box.left - 5, at(value));
  }
  context.textAlign = 'left';
  context.fillText(unit, box.left + 4, box.top - 8);
  return at;
}

// A legend of lines: {name, colour, dash}.
export function legend(parent, lines) {
  const made = rows(parent, lines.length, () => {
    const one = element('span');
    one.append(byId('line-sample').content.cloneNode(true), element('span'));
    return one;
  });
  lines.forEach(({name, colour, dash}, index) => {
    const line = made[index].firstChild.firstChild;
    line.setAttribute('stroke', colour);
    line.setAttribute('stroke-dasharray', dash.join(' '));
    set(made[index].lastChild, name);
  });
}
