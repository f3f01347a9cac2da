// The error maps: errors of each rotary axis over its position, with U (k = 2).
import {cell} from './connection.js';
import {COLOURS, DASHES, frame, legend, limits, prepared} from './drawing.js';
import {byId, element, minus, number} from './dom.js';

export function drawMaps() {
  const maps = Object.keys(cell.parts).filter((name) => name.startsWith('map:')).sort()
    .map((name) => cell.parts[name]);
  byId('maps-card').hidden = !maps.length;
  byId('maps').replaceChildren();
  const outer = maps.find((map) => !map.levels.length);
  for (const map of maps) drawAxis(map, outer ? outer.axis : 'other axis');
}

// Where a map has levels, it is over the stations of the axis `other` too.
function drawAxis(map, other) {
  const box = byId('maps');
  const how = map.levels.length ? `one line for each station of ${other}, ` +
    'above each map its largest U (k = 2)' : 'bands: U (k = 2)';
  box.append(element('h3', '', `Axis ${map.axis}, over its own position: ${how}`));
  if (map.levels.length) {
    const names = element('p', 'legend');
    legend(names, map.levels.map((level, n) =>
      ({name: `${other} ${minus(level)}°`, ...lineOf(map, n)})));
    box.append(names);
  }
  const open = map.symbols.filter((one) => one.lines.flat().every((value) => value === null));
  if (open.length) {
    box.append(element('p', 'quiet', 'Not determined by these poses: ' +
      open.map((one) => one.symbol).join(', ')));
  }
  for (const one of map.symbols.filter((symbol) => !open.includes(symbol))) {
    const figure = element('figure'), canvas = element('canvas');
    const most = Math.max(...one.U.flat().filter((value) => value !== null));
    const spread = map.levels.length && most > 0 ? `, U ≤ ${number(most, 2)}` : '';
    figure.append(element('figcaption', '', `${one.symbol} [${one.unit}]${spread}`), canvas);
    box.append(figure);
    drawMap(canvas, map, one);
  }
}

// Colour and dash of a map's line.
function lineOf(map, n) {
  if (!map.levels.length) return {colour: COLOURS[0], dash: []};
  return {
    colour: `hsl(${210 + 150 * n / map.levels.length}, 70%, 38%)`, dash: DASHES[n % DASHES.length],
  };
}

function drawMap(canvas, map, one) {
  const [context, wide] = prepared(canvas, 150);
  const values = one.lines.flatMap((line, n) => line.flatMap((value, k) =>
    value === null ? [] : map.levels.length ? [value] :
      [value - (one.U[n][k] || 0), value + (one.U[n][k] || 0)]));
  const ends = limits([0, ...values]);
  const box = {left: 48, right: wide - 8, top: 12, bottom: 126};
  const at = frame(context, box, ends[0], ends[1], '');
  const low = Math.min(...map.over), high = Math.max(...map.over);
  const x = (value) => box.left + 6 + (value - low) / (high - low || 1) *
    (box.right - box.left - 12);
  context.textBaseline = 'top';
  for (const value of [low, (low + high) / 2, high]) {
    context.textAlign = value === low ? 'left' : value === high ? 'right' : 'center';
    context.fillText(`${number(value, 0)}°`, x(value), box.bottom + 4);
  }
  one.lines.forEach((line, n) => {
    const points = line.map((value, k) => [x(map.over[k]), value, one.U[n][k]]);
    if (!map.levels.length) drawBand(context, points, at);
    drawLine(context, points, at, lineOf(map, n));
  });
}

// What lies within U of the values; points (u [px], value, U).
function drawBand(context, points, at) {
  context.fillStyle = 'rgba(0, 114, 178, .18)';
  context.beginPath();
  const known = points.filter(([, value]) => value !== null);
  known.forEach(([u, value, spread], k) =>
    k ? context.lineTo(u, at(value + spread)) : context.moveTo(u, at(value + spread)));
  known.reverse().forEach(([u, value, spread]) => context.lineTo(u, at(value - spread)));
  context.fill();
}

// A line through the values, open where one is not known.
function drawLine(context, points, at, {colour, dash}) {
  context.strokeStyle = context.fillStyle = colour;
  context.lineWidth = 1.6;
  context.setLineDash(dash);
  context.beginPath();
  let open = true;
  for (const [u, value] of points) {
    if (value !== null) {
      if (open) context.moveTo(u, at(value));
      else context.lineTo(u, at(value));
    }
    open = value === null;
  }
  context.stroke();
  context.setLineDash([]);
  for (const [u, value] of points) {
    if (value !== null) context.fillRect(u - 2, at(value) - 2, 4, 4);
  }
}
