// The strip chart: the gauges or the sphere over the last minute.
import {HISTORY_S, cell} from './connection.js';
import {COLOURS, QUIET, frame, legend, limits, prepared} from './drawing.js';
import {byId, choice} from './dom.js';

let shown = 'gauges', seconds = HISTORY_S;

export function startStrip() {
  choice('strip-choice', (show) => { shown = show; });
  choice('span-choice', (show) => { seconds = Number(show); });
}

export function drawStrip() {
  const [context, wide] = prepared(byId('strip'), 190);
  const gauges = shown === 'gauges', now = cell.live.t;
  const names = gauges ? cell.live.gauges.map((one) => one.name) : ['X', 'Y', 'Z'];
  const span = (row, index) => gauges ? row.spans[index] :
    row.sphere && [row.sphere[index], row.sphere[index]];
  const recent = cell.strip.filter((row) => row.t > now - seconds);
  const all = [];
  for (const row of recent) {
    names.forEach((_, index) => { const one = span(row, index); if (one) all.push(...one); });
  }
  const ends = limits(all);
  legend(byId('strip-legend'),
    names.map((name, index) => ({name, colour: colourOf(index), dash: []})));
  if (!ends) {
    context.fillStyle = QUIET;
    context.fillText(`no valid values in the last ${seconds} seconds`, 20, 90);
    return;
  }
  const box = {left: 62, right: wide - 34, top: 22, bottom: 166};
  const at = frame(context, box, ends[0], ends[1], 'µm, full scale follows the values');
  const x = (t) => box.right - (now - t) / seconds * (box.right - box.left);
  drawTimes(context, box, x, now);
  names.forEach((_, index) => {
    drawLine(context, recent.map((row) => [row.t, span(row, index)]), x, at, colourOf(index));
  });
  nameLines(context, box, names.map((name, index) => {
    const one = recent.slice(-5).map((row) => span(row, index)).filter((s) => s).pop();
    return one && {name: name.replace('gauge ', ''), y: at(one[1]), colour: colourOf(index)};
  }).filter((one) => one));
}

function colourOf(index) {
  return COLOURS[index % COLOURS.length];
}

function drawTimes(context, box, x, now) {
  context.textBaseline = 'top';
  for (const part of [1, 0.75, 0.5, 0.25, 0]) {
    const ago = part * seconds;
    context.textAlign = ago === 0 ? 'right' : 'center';
    context.fillText(ago ? `−${ago} s` : 'now', x(now - ago), box.bottom + 5);
  }
}

// From the smallest to the largest value of each tick: (t [s], [low, high] [µm] or nothing).
function drawLine(context, ticks, x, at, colour) {
  context.strokeStyle = colour;
  context.lineWidth = 1.8;
  context.beginPath();
  let before = null;
  for (const [t, one] of ticks) {
    // A gap stays a gap: nothing is drawn across it.
    if (!one) continue;
    if (before === null || t - before > 0.5) context.moveTo(x(t), at(one[0]));
    else context.lineTo(x(t), at(one[0]));
    context.lineTo(x(t), at(one[1]));
    before = t;
  }
  context.stroke();
}

// Names beside the ends of the lines, apart enough to be read: no line is told by colour alone.
function nameLines(context, box, ends) {
  const apart = 17, room = (ends.length - 1) * apart;
  ends.sort((a, b) => a.y - b.y);
  let y = -Infinity;
  context.textAlign = 'left';
  context.textBaseline = 'middle';
  context.font = 'bold 15px system-ui, sans-serif';
  ends.forEach((one, index) => {
    const lowest = box.bottom - room + index * apart;
    y = Math.max(y + apart, Math.min(one.y, lowest));
    context.fillStyle = one.colour;
    context.fillText(one.name, box.right + 8, y);
  });
}
