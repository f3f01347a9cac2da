// Where the nest is, error magnified: the identifier's markers, turned as a person wants them.
import {cell} from './connection.js';
import {DASHES, INK, legend, limits, prepared, steps} from './drawing.js';
import {byId, choice, element, rows, set} from './dom.js';

// Of visualization_msgs/Marker.type.
const LINE_STRIP = 4, LINE_LIST = 5;
const PLANES = {XZ: [0, 2], XY: [0, 1], YZ: [1, 2]};

let plane = '3-D', shownLevel = '';
const turn = {azimuth: -0.6, height: 0.45};

export function startPicture() {
  choice('picture-choice', (show) => { plane = show; drawPicture(); });
  const picture = byId('picture');
  let from = null;
  picture.onpointerdown = (event) => { from = [event.clientX, event.clientY, {...turn}]; };
  picture.onpointermove = (event) => {
    if (!from || plane !== '3-D') return;
    turn.azimuth = from[2].azimuth + (event.clientX - from[0]) / 150;
    turn.height = from[2].height + (event.clientY - from[1]) / 150;
    requestAnimationFrame(drawPicture);
  };
  window.addEventListener('pointerup', () => { from = null; });
}

export function drawPicture() {
  const markers = cell.parts.picture;
  byId('picture-card').hidden = !markers;
  if (!markers) return;
  const [context, wide] = prepared(byId('picture'), 440);
  const note = markers.find((one) => one.group === 'magnification');
  set(byId('picture-factor'), note ? note.text : '');
  chooseLevel([...new Set(markers.filter((one) => one.points.length).map((one) => one.text))]);
  const lines = markers.filter((one) => one.points.length &&
    (!shownLevel || one.text === shownLevel));
  const all = lines.flatMap((one) => one.points);
  if (!all.length) return;
  const project = projector(all), flat = all.map(project);
  const xs = limits(flat.map((p) => p[0])), ys = limits(flat.map((p) => p[1]));
  const scale = Math.min((wide - 20) / (xs[1] - xs[0]), 410 / (ys[1] - ys[0]));
  const place = (point) => {
    const [u, v] = project(point);
    return [wide / 2 + (u - (xs[0] + xs[1]) / 2) * scale, 215 - (v - (ys[0] + ys[1]) / 2) * scale];
  };
  const setups = [...new Set(lines.map((one) => one.group.split('/'))
    .filter(([kind]) => kind === 'measured').map(([, setup]) => setup))];
  const shown = {};
  for (const one of lines) {
    const [kind, setup] = one.group.split('/');
    const colour = `rgb(${one.colour.map((part) => Math.round(255 * part)).join(',')})`;
    const dash = DASHES[Math.max(0, setups.indexOf(setup)) % DASHES.length];
    if (kind === 'measured') shown[setup] = {name: `sphere ${setup}`, colour, dash};
    drawMarker(context, one.type, kind, one.points.map(place), colour, dash);
  }
  drawArms(context, project);
  scaleBar(context, scale, note);
  legend(byId('picture-legend'), Object.values(shown));
}

// From (x, y, z) [mm] to the plane of the picture [mm].
function projector(points) {
  const middle = [0, 1, 2].map((axis) => {
    let low = Infinity, high = -Infinity;
    for (const point of points) {
      low = Math.min(low, point[axis]);
      high = Math.max(high, point[axis]);
    }
    return (low + high) / 2;
  });
  const [ca, sa] = [Math.cos(turn.azimuth), Math.sin(turn.azimuth)];
  const [ch, sh] = [Math.cos(turn.height), Math.sin(turn.height)];
  return (point) => {
    const [x, y, z] = point.map((value, axis) => value - middle[axis]);
    if (PLANES[plane]) return PLANES[plane].map((axis) => [x, y, z][axis]);
    return [ca * x - sa * y, ch * z + sh * (sa * x + ca * y)];
  };
}

// Lines as they are, commanded positions as circles, measured ones as crosses.
function drawMarker(context, type, kind, places, colour, dash) {
  context.strokeStyle = context.fillStyle = colour;
  context.lineWidth = kind === 'average circle' ? 2 : kind === 'table' ? 0.5 : 1;
  context.setLineDash(kind === 'average circle' ? dash : []);
  context.beginPath();
  if (type === LINE_STRIP) {
    places.forEach(([u, v], n) => n ? context.lineTo(u, v) : context.moveTo(u, v));
  } else if (type === LINE_LIST) {
    for (let n = 0; n + 1 < places.length; n += 2) {
      context.moveTo(...places[n]);
      context.lineTo(...places[n + 1]);
    }
  } else if (kind === 'command') {
    for (const [u, v] of places) { context.moveTo(u + 2.5, v); context.arc(u, v, 2.5, 0, 7); }
  } else {
    for (const [u, v] of places) {
      context.moveTo(u - 4, v - 4); context.lineTo(u + 4, v + 4);
      context.moveTo(u - 4, v + 4); context.lineTo(u + 4, v - 4);
    }
  }
  context.stroke();
  context.setLineDash([]);
}

// One level of the stepping axis, or all of them.
function chooseLevel(levels) {
  if (!levels.includes(shownLevel)) shownLevel = '';
  const names = levels.length > 1 ? ['', ...levels] : [];
  const made = rows(byId('level-choice'), names.length, () => element('button'));
  names.forEach((name, index) => {
    set(made[index], name || 'all', name === shownLevel ? 'chosen' : '');
    made[index].onclick = () => { shownLevel = name; drawPicture(); };
  });
}

// The directions of X, Y and Z.
function drawArms(context, project) {
  const origin = project([0, 0, 0]);
  context.lineWidth = 2;
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  ['X', 'Y', 'Z'].forEach((name, axis) => {
    const tip = project([0, 0, 0].map((_, n) => n === axis ? 1 : 0));
    const [du, dv] = [tip[0] - origin[0], origin[1] - tip[1]];
    if (Math.hypot(du, dv) < 0.05) return;
    context.strokeStyle = context.fillStyle = INK;
    context.beginPath();
    context.moveTo(50, 60);
    context.lineTo(50 + 34 * du, 60 + 34 * dv);
    context.stroke();
    context.fillText(name, 50 + 44 * du, 60 + 44 * dv);
  });
}

// A length of the machine, and what the same length means of an error.
function scaleBar(context, scale, note) {
  const length = steps(0, 180 / scale, 2).pop();
  const factor = note ? Number(note.text.replace(/[^0-9.]/g, '')) : 0;
  const left = 14, bottom = 428;
  context.strokeStyle = context.fillStyle = INK;
  context.lineWidth = 3;
  context.beginPath();
  context.moveTo(left, bottom);
  context.lineTo(left + length * scale, bottom);
  context.stroke();
  context.textAlign = 'left';
  context.textBaseline = 'bottom';
  const error = factor ? ` of the machine, ${Number((1e3 * length / factor).toPrecision(3))} µm` +
    ' of error' : '';
  context.fillText(`${length} mm${error}`, left, bottom - 4);
}
