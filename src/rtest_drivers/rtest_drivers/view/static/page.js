// Shows what the server sends: `history` once, `part` when something changed, `live` ten times a
// second. Everything is drawn from the last values, at most once a frame; nothing is queued.
'use strict';

const byId = (id) => document.getElementById(id);
const KEY = document.querySelector('meta[name=rtest-key]').content || location.hash.slice(1);
const WORDS = {ok: 'OK', warn: 'WARNING', error: 'ERROR', idle: 'IDLE'};
// Colour-blind safe (Okabe and Ito 2008), each with a dash of its own.
const COLOURS = ['#0072B2', '#D55E00', '#007a5a', '#a0457f', '#7a6200', '#56B4E9'];
const HISTORY_S = 60;
// Values are old when nothing came for this long [ms].
const LOST_MS = 1500;
const POSE_WORDS = {open: 'to come', reached: 'reached', done: 'measured', missing: 'missing'};
// So that no line of a map is told by its colour alone.
const DASHES = [['solid', []], ['dashed', [7, 4]], ['dotted', [2, 3]]];

let live = null, heard = 0, drawn = true;
let strip = [];
const parts = {};
let shownCycle = null, shownPose = null, stripOf = 'gauges', stripSpan = HISTORY_S, plane = '3-D', shownLevel = '';
let turn = {azimuth: -0.6, height: 0.45};

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function set(node, text, className) {
  if (node.textContent !== text) node.textContent = text;
  if (className !== undefined && node.className !== className) node.className = className;
}

// A list of elements that is made anew only when its length changes.
function rows(parent, count, make) {
  while (parent.children.length > count) parent.lastChild.remove();
  while (parent.children.length < count) parent.append(make(parent.children.length));
  return [...parent.children];
}

function number(value, digits) {
  if (value === null || value === undefined) return '–';
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace('-', '') : text.replace('-', '−');
}

// ---- what comes ----

function connect() {
  const source = new EventSource('/events');
  source.addEventListener('history', (event) => { strip = JSON.parse(event.data); });
  source.addEventListener('part', (event) => {
    const {name, shown} = JSON.parse(event.data);
    if (shown === null) delete parts[name]; else parts[name] = shown;
    if (shown === null && name.startsWith('cycle:')) shownCycle = null;
    showPart(name);
  });
  source.addEventListener('live', (event) => {
    live = JSON.parse(event.data);
    heard = performance.now();
    if (live === null) return;
    strip.push({t: live.t, spans: live.spans, sphere: live.sphere});
    while (strip.length && strip[0].t < live.t - HISTORY_S) strip.shift();
    if (drawn) { drawn = false; requestAnimationFrame(draw); }
  });
}

function watch() {
  const old = performance.now() - heard;
  document.body.classList.toggle('lost', Boolean(heard) && old > LOST_MS);
  if (!heard) set(byId('link'), 'CONNECTING', 'badge idle');
  else if (old > LOST_MS) {
    set(byId('link'), `NO CONNECTION for ${(old / 1000).toFixed(0)} s: all values are old`,
      'badge error');
  } else set(byId('link'), 'LIVE', 'badge ok');
}

// ---- live ----

function draw() {
  drawn = true;
  if (live === null) return;
  const session = live.session;
  set(byId('session'), session.name || 'R-test cell');
  const place = session.cycles ? `cycle ${session.cycle} of ${session.cycles}: ` : '';
  set(byId('doing'), place + session.text);
  // What the session waits for stands out.
  document.querySelector('[data-wish=start]').classList.toggle('chosen', Boolean(session.waits));
  drawDevices();
  drawGauges();
  drawAxes();
  drawSphere();
  drawRecording();
  drawStrip();
}

function drawDevices() {
  const made = rows(byId('devices').tBodies[0], live.devices.length, () => {
    const row = element('tr');
    row.append(element('th'), element('td'), element('td'), element('td', 'number'));
    row.children[1].append(element('span'));
    return row;
  });
  live.devices.forEach((one, index) => {
    const [name, level, text, figures] = made[index].children;
    made[index].dataset.device = one.name;
    made[index].dataset.level = one.level;
    set(name, one.name);
    set(level.firstChild, WORDS[one.level], `badge ${one.level}`);
    set(text, one.text);
    const rate = one.rate === null ? '' : `${number(one.rate, 1)} /s, `;
    set(figures, one.age === null ? '' : `${rate}${one.age.toFixed(1)} s ago`);
  });
}

// Where a range is not told: the largest value of the last minute, rounded up.
function scaleOf(index) {
  let most = 10;
  for (const row of strip) {
    const span = row.spans[index];
    if (span) most = Math.max(most, -span[0], span[1]);
  }
  const power = 10 ** Math.floor(Math.log10(most));
  const end = [1, 2, 5, 10].find((step) => step * power >= most) * power;
  return [-end, end];
}

function drawBar(bar, value, range) {
  const [fill, zero, needle] = bar.children;
  const place = (v) => 100 * Math.min(1, Math.max(0, (v - range[0]) / (range[1] - range[0])));
  const middle = place(0), at = value === null ? middle : place(value);
  fill.style.left = `${Math.min(middle, at)}%`;
  fill.style.width = `${Math.abs(at - middle)}%`;
  zero.style.left = `${middle}%`;
  needle.style.left = `${at}%`;
  needle.hidden = value === null;
}

function newBar() {
  const bar = element('div', 'bar');
  bar.append(element('div', 'fill'), element('div', 'zero'), element('div', 'needle'));
  return bar;
}

function drawGauges() {
  const made = rows(byId('gauges'), live.gauges.length, () => {
    const row = element('div', 'gauge'), middle = element('div'), ends = element('div', 'ends');
    ends.append(element('span'), element('span'), element('span'));
    middle.append(newBar(), ends);
    const value = element('div', 'value');
    value.append(element('span', 'figure'), element('span', 'unit', ' µm'));
    row.append(element('b'), middle, value, element('span'));
    return row;
  });
  live.gauges.forEach((one, index) => {
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
  if (!live.gauges.length) set(byId('gauges'), '');
}

function drawAxes() {
  const made = rows(byId('axes'), live.axes.length, () => {
    const row = element('div', 'axis'), value = element('div', 'value');
    value.append(element('span', 'figure'), element('span', 'unit'));
    row.append(element('b'), newBar(), value);
    return row;
  });
  live.axes.forEach((one, index) => {
    const [name, bar, value] = made[index].children;
    made[index].dataset.axis = one.name;
    set(name, one.name);
    bar.style.visibility = one.range ? 'visible' : 'hidden';
    if (one.range) drawBar(bar, one.value, one.range);
    set(value.firstChild, number(one.value, 4), one.alive ? 'figure' : 'figure old');
    set(value.lastChild, (one.unit === '°' ? '°' : ` ${one.unit}`) + (one.alive ? '' : ' old'));
  });
}

function drawSphere() {
  const made = rows(byId('sphere'), 3, (index) => {
    const one = element('span', 'value');
    one.append(element('span', 'unit', 'XYZ'[index] + ' '), element('span', 'figure'),
      element('span', 'unit', ' µm'));
    return one;
  });
  made.forEach((one, index) => {
    set(one.children[1], live.sphere ? number(live.sphere[index], 2) : '–');
  });
}

function bytes(value) {
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  let left = Number(value), unit = 0;
  while (left >= 1000 && unit < units.length - 1) { left /= 1000; unit += 1; }
  return `${left.toFixed(unit ? 1 : 0)} ${units[unit]}`;
}

function drawRecording() {
  const one = live.recording;
  const lines = [['state', `${WORDS[one.level]}: ${one.text}`]];
  if (one.bytes) lines.push(['size', bytes(one.bytes)]);
  if (one.disk_free) lines.push(['disk left', bytes(one.disk_free)]);
  if (one.lost) {
    lines.push(['lost', one.lost === '0' ? 'nothing' : `${one.lost} readings or messages`]);
  }
  if (one.file) lines.push(['file', one.file.split('/').pop()]);
  if (parts.marks && parts.marks.length) {
    lines.push(['last mark', parts.marks[parts.marks.length - 1]]);
  }
  const made = rows(byId('recording'), 2 * lines.length,
    (index) => element(index % 2 ? 'dd' : 'dt'));
  lines.forEach(([name, text], index) => {
    set(made[2 * index], name);
    set(made[2 * index + 1], text,
      name === 'state' || (name === 'lost' && one.lost !== '0') ? `badge ${one.level}` : '');
  });
}

// ---- drawing ----

function prepared(canvas, height) {
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
function steps(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((one) => one * power >= raw) * power;
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high + 1e-9 * step; n += 1) {
    found.push(Number((n * step).toPrecision(12)));
  }
  return found;
}

function limits(values) {
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

function frame(context, box, low, high, unit) {
  const at = (value) => box.bottom - (value - low) / (high - low) * (box.bottom - box.top);
  context.fillStyle = '#56616c';
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
    context.fillText(String(value).replace('-', '−'), box.left - 5, at(value));
  }
  context.textAlign = 'left';
  context.fillText(unit, box.left + 4, box.top - 8);
  return at;
}

function legend(id, names) {
  const made = rows(byId(id), names.length, () => {
    const one = element('span');
    one.append(element('i'), element('span'));
    return one;
  });
  names.forEach((name, index) => {
    made[index].firstChild.style.borderColor = COLOURS[index % COLOURS.length];
    set(made[index].lastChild, name);
  });
}

function drawStrip() {
  const [context, wide] = prepared(byId('strip'), 190);
  const gauges = stripOf === 'gauges';
  const names = gauges ? live.gauges.map((one) => one.name) : ['X', 'Y', 'Z'];
  const span = (row, index) => gauges ? row.spans[index] :
    row.sphere && [row.sphere[index], row.sphere[index]];
  const recent = strip.filter((row) => row.t > live.t - stripSpan);
  const all = [];
  for (const row of recent) {
    names.forEach((_, index) => { const one = span(row, index); if (one) all.push(...one); });
  }
  const ends = limits(all);
  legend('strip-legend', names);
  if (!ends) {
    context.fillStyle = '#56616c';
    context.fillText(`no valid values in the last ${stripSpan} seconds`, 20, 90);
    return;
  }
  const box = {left: 62, right: wide - 34, top: 22, bottom: 166};
  const at = frame(context, box, ends[0], ends[1], 'µm, full scale follows the values');
  const x = (t) => box.right - (live.t - t) / stripSpan * (box.right - box.left);
  context.textAlign = 'center';
  context.textBaseline = 'top';
  for (const part of [1, 0.75, 0.5, 0.25, 0]) {
    const ago = part * stripSpan;
    const place = x(live.t - ago);
    context.textAlign = ago === 0 ? 'right' : 'center';
    context.fillText(ago ? `−${ago} s` : 'now', place, box.bottom + 5);
  }
  names.forEach((_, index) => {
    context.strokeStyle = COLOURS[index % COLOURS.length];
    context.lineWidth = 1.8;
    context.beginPath();
    let before = null;
    for (const row of recent) {
      const one = span(row, index);
      // A gap stays a gap: nothing is drawn across it.
      if (!one) continue;
      if (before === null || row.t - before > 0.5) context.moveTo(x(row.t), at(one[0]));
      else context.lineTo(x(row.t), at(one[0]));
      context.lineTo(x(row.t), at(one[1]));
      before = row.t;
    }
    context.stroke();
  });
  nameLines(context, box, names.map((name, index) => {
    const one = recent.slice(-5).map((row) => span(row, index)).filter((s) => s).pop();
    return one && {name: name.replace('gauge ', ''), y: at(one[1]), colour: COLOURS[index]};
  }).filter((one) => one));
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

// ---- poses ----

function cycleNames() {
  return Object.keys(parts).filter((name) => name.startsWith('cycle:'))
    .sort((a, b) => Number(a.slice(6)) - Number(b.slice(6)));
}

function drawPoses() {
  const names = cycleNames();
  const last = names[names.length - 1];
  if (!last) { byId('cycles').replaceChildren(); byId('poses').replaceChildren(); return; }
  // The last one is followed unless a person has chosen another.
  const current = shownCycle && parts[shownCycle] ? shownCycle : last;
  const made = rows(byId('cycles'), names.length, () => element('button'));
  names.forEach((name, index) => {
    const one = parts[name];
    const label = `${one.cycle}${one.finished ? one.missing ? ' ⚠' : ' ✓' : ' …'}`;
    set(made[index], label, name === current ? 'chosen' : '');
    made[index].onclick = () => {
      shownCycle = name === last ? null : name;
      shownPose = null;
      drawPoses();
    };
  });
  const one = parts[current], grid = byId('poses');
  const all = one.states.length;
  set(byId('poses-title'), `${one.kind}, sphere ${one.setup}: ` + (one.finished ?
    `${one.done} of ${all} measured` + (one.missing ? `, ${one.missing} MISSING` : '') :
    `${one.reached} of ${all} reached, measured or not is known at its end`));
  drawGrid(grid, one, current);
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
    grid.replaceChildren();
    const wide = Math.max(...one.places.map((place) => place[1])) + 1;
    const labelled = one.rows.length > 0;
    grid.style.gridTemplateColumns =
      (labelled ? 'max-content ' : '') + `repeat(${wide}, minmax(26px, 1fr))`;
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
  for (const button of grid.querySelectorAll('button')) {
    const state = one.states[button.dataset.pose];
    set(button, {open: '·', reached: '○', done: '✓', missing: '✗'}[state], state);
    button.setAttribute('aria-label', `${one.names[button.dataset.pose]}: ${POSE_WORDS[state]}`);
  }
}

function showPose(one, index) {
  const state = POSE_WORDS[one.states[index]];
  const why = one.reasons[index] ? `: ${one.reasons[index]}` : '';
  set(byId('pose-name'), `Pose ${index}, ${one.names[index]}: ${state}${why}`);
}

// ---- results ----

function showPart(name) {
  if (name.startsWith('cycle:')) drawPoses();
  else if (['location', 'warnings', 'gap', 'gap_notes'].includes(name)) drawLocation();
  else if (name === 'picture') drawPicture();
  else if (name.startsWith('map:')) drawMaps();
}

function drawLocation() {
  const found = parts.location;
  byId('location-card').hidden = !found;
  if (!found) return;
  set(byId('location-note'), `residual ${number(found.residual, 2)} µm rms`);
  const made = rows(byId('location').tBodies[0], found.rows.length, () => {
    const row = element('tr');
    row.append(element('th'), element('td'), element('td'), element('td'));
    return row;
  });
  found.rows.forEach((one, index) => {
    const [symbol, value, spread, unit] = made[index].children;
    set(symbol, one.symbol);
    set(value, number(one.value, 2));
    set(spread, `± ${number(one.U, 2)}`);
    set(unit, one.unit);
  });
  const warnings = parts.warnings || [];
  const list = rows(byId('warnings'), warnings.length, () => element('li'));
  warnings.forEach((text, index) => set(list[index], text));
  byId('warnings').hidden = !warnings.length;
  drawGap();
}

function drawGap() {
  const gap = parts.gap, box = byId('gap');
  box.replaceChildren();
  if (!gap) {
    box.append(element('p', 'quiet', 'The model is compared with the measurement at the end.'));
    return;
  }
  const level = {'no gap': 'ok', explained: 'ok', 'partly explained': 'warn'}[gap.verdict]
    || 'error';
  const line = element('p', '', 'Model against measurement: ');
  line.append(element('span', `badge ${level}`, gap.verdict));
  box.append(line);
  const after = gap.effects.length ?
    `; with the effects below ${number(gap.after, 2)} µm` : '; no known effect was added';
  box.append(element('p', 'quiet', `The model leaves ${number(gap.before, 2)} µm, of which ` +
    `${number(gap.noise, 2)} µm are noise${after} (rms).`));
  const list = element('ul');
  for (const one of gap.effects) {
    const others = one.rivals ? `; cannot be told from ${one.rivals}` : '';
    list.append(element('li', '',
      `${one.key} (${Math.round(100 * one.confidence)} % sure${others})`));
  }
  for (const text of parts.gap_notes || []) list.append(element('li', 'quiet', text));
  box.append(list);
}

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
  const flat = {XZ: [0, 2], XY: [0, 1], YZ: [1, 2]}[plane];
  return (point) => {
    const [x, y, z] = point.map((value, axis) => value - middle[axis]);
    if (flat) return flat.map((axis) => [x, y, z][axis]);
    return [ca * x - sa * y, ch * z + sh * (sa * x + ca * y)];
  };
}

function drawPicture() {
  const markers = parts.picture;
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
  const x = (p) => wide / 2 + (p[0] - (xs[0] + xs[1]) / 2) * scale;
  const y = (p) => 215 - (p[1] - (ys[0] + ys[1]) / 2) * scale;
  const setups = [];
  for (const one of lines) {
    const [kind, setup] = one.group.split('/');
    const colour = `rgb(${one.colour.map((part) => Math.round(255 * part)).join(',')})`;
    if (kind === 'measured' && !setups.some((s) => s.name === setup)) {
      setups.push({name: setup, colour});
    }
    context.strokeStyle = context.fillStyle = colour;
    const places = one.points.map(project).map((p) => [x(p), y(p)]);
    context.lineWidth = kind === 'average circle' ? 2 : kind === 'table' ? 0.5 : 1;
    context.beginPath();
    if (one.type === 4) places.forEach(([u, v], n) => n ? context.lineTo(u, v) :
      context.moveTo(u, v));
    else if (one.type === 5) {
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
  }
  drawArms(context, project, scale);
  scaleBar(context, wide, scale, note);
  const made = rows(byId('picture-legend'), setups.length, () => {
    const one = element('span');
    one.append(element('i'), element('span'));
    return one;
  });
  setups.forEach((one, index) => {
    made[index].firstChild.style.borderColor = one.colour;
    set(made[index].lastChild, `sphere ${one.name}`);
  });
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
function drawArms(context, project, scale) {
  const origin = project([0, 0, 0]);
  context.lineWidth = 2;
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  ['X', 'Y', 'Z'].forEach((name, axis) => {
    const tip = project([0, 0, 0].map((_, n) => n === axis ? 1 : 0));
    const [du, dv] = [tip[0] - origin[0], origin[1] - tip[1]];
    if (Math.hypot(du, dv) < 0.05) return;
    context.strokeStyle = context.fillStyle = '#15202b';
    context.beginPath();
    context.moveTo(50, 60);
    context.lineTo(50 + 34 * du, 60 + 34 * dv);
    context.stroke();
    context.fillText(name, 50 + 44 * du, 60 + 44 * dv);
  });
}

// A length of the machine, and what the same length means of an error.
function scaleBar(context, wide, scale, note) {
  const length = steps(0, 180 / scale, 2).pop();
  const factor = note ? Number(note.text.replace(/[^0-9.]/g, '')) : 0;
  const left = 14, bottom = 428;
  context.strokeStyle = context.fillStyle = '#15202b';
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

function drawMaps() {
  const maps = Object.keys(parts).filter((name) => name.startsWith('map:')).sort();
  byId('maps-card').hidden = !maps.length;
  byId('maps').replaceChildren();
  const outer = maps.map((name) => parts[name]).find((map) => !map.levels.length);
  const other = outer ? outer.axis : 'other axis';
  for (const name of maps) {
    const map = parts[name];
    const how = map.levels.length ? `one line for each station of ${other}, ` +
      'above each map its largest U (k = 2)' : 'bands: U (k = 2)';
    byId('maps').append(element('h3', '', `Axis ${map.axis}, over its own position: ${how}`));
    if (map.levels.length) byId('maps').append(levelLegend(map.levels, other));
    const open = map.symbols.filter((one) => one.lines.flat().every((value) => value === null));
    if (open.length) {
      byId('maps').append(element('p', 'quiet', 'Not determined by these poses: ' +
        open.map((one) => one.symbol).join(', ')));
    }
    for (const one of map.symbols.filter((other) => !open.includes(other))) {
      const figure = element('figure'), canvas = element('canvas');
      const most = Math.max(...one.U.flat().filter((value) => value !== null));
      const spread = map.levels.length && most > 0 ? `, U ≤ ${number(most, 2)}` : '';
      figure.append(element('figcaption', '', `${one.symbol} [${one.unit}]${spread}`), canvas);
      byId('maps').append(figure);
      drawMap(canvas, map, one);
    }
  }
}

function levelColour(n, count) {
  return `hsl(${210 + 150 * n / count}, 70%, 38%)`;
}

function levelLegend(levels, axis) {
  const made = element('p', 'legend');
  levels.forEach((level, n) => {
    const one = element('span'), line = element('i');
    line.style.borderColor = levelColour(n, levels.length);
    line.style.borderTopStyle = DASHES[n % DASHES.length][0];
    one.append(line, element('span', '', `${axis} ${String(level).replace('-', '−')}°`));
    made.append(one);
  });
  return made;
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
  context.textAlign = 'center';
  for (const value of [low, (low + high) / 2, high]) {
    context.textAlign = value === low ? 'left' : value === high ? 'right' : 'center';
    context.fillText(`${number(value, 0)}°`, x(value), box.bottom + 4);
  }
  one.lines.forEach((line, n) => {
    const colour = map.levels.length ? levelColour(n, one.lines.length) : COLOURS[0];
    context.setLineDash(map.levels.length ? DASHES[n % DASHES.length][1] : []);
    if (!map.levels.length) {
      context.fillStyle = 'rgba(0, 114, 178, .18)';
      context.beginPath();
      const known = line.map((value, k) => [value, one.U[n][k], x(map.over[k])])
        .filter(([value]) => value !== null);
      known.forEach(([value, spread, u], k) =>
        k ? context.lineTo(u, at(value + spread)) : context.moveTo(u, at(value + spread)));
      known.reverse().forEach(([value, spread, u]) => context.lineTo(u, at(value - spread)));
      context.fill();
    }
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = 1.6;
    context.beginPath();
    let open = true;
    line.forEach((value, k) => {
      if (value === null) { open = true; return; }
      if (open) context.moveTo(x(map.over[k]), at(value));
      else context.lineTo(x(map.over[k]), at(value));
      open = false;
    });
    context.stroke();
    line.forEach((value, k) => {
      if (value !== null) context.fillRect(x(map.over[k]) - 2, at(value) - 2, 4, 4);
    });
  });
}

// ---- controls ----

function say(text, level) {
  set(byId('answer'), text, level);
}

async function post(path, body) {
  say('asking …', '');
  try {
    const response = await fetch(path, {
      method: 'POST',
      headers: {'Content-Type': 'application/json', 'X-Rtest-Key': KEY},
      body: JSON.stringify(body),
    });
    const answer = await response.json();
    say((answer.granted ? 'Done: ' : 'Refused: ') + answer.answer, answer.granted ? 'ok' : 'error');
    return answer.granted;
  } catch (error) {
    say('No answer: the connection to the server is lost.', 'error');
    return false;
  }
}

// What ends something is asked for twice, with a second tap within four seconds.
function onWish(button) {
  if (!button.dataset.sure || button.classList.contains('sure')) {
    calm(button);
    post('/ask', {wish: button.dataset.wish});
    return;
  }
  button.dataset.label = button.textContent;
  button.classList.add('sure');
  button.textContent = `Tap again: ${button.dataset.sure}`;
  button.timer = setTimeout(() => calm(button), 4000);
}

function calm(button) {
  if (!button.classList.contains('sure')) return;
  clearTimeout(button.timer);
  button.classList.remove('sure');
  button.textContent = button.dataset.label;
}

function start() {
  for (const button of document.querySelectorAll('[data-wish]')) {
    button.onclick = () => onWish(button);
    button.disabled = !KEY;
  }
  if (!KEY) {
    say('Looking only: controls need the address with its key, as rtest view printed it.', '');
    byId('mark').querySelector('button').disabled = true;
  }
  byId('mark').onsubmit = async (event) => {
    event.preventDefault();
    if (await post('/mark', {text: byId('mark-text').value})) byId('mark-text').value = '';
  };
  const choose = (id, then) => {
    for (const button of byId(id).children) {
      button.onclick = () => {
        for (const other of byId(id).children) other.classList.toggle('chosen', other === button);
        then(button.dataset.show);
      };
    }
  };
  choose('strip-choice', (show) => { stripOf = show; });
  choose('span-choice', (show) => { stripSpan = Number(show); });
  choose('picture-choice', (show) => { plane = show; drawPicture(); });
  let from = null;
  const picture = byId('picture');
  picture.onpointerdown = (event) => { from = [event.clientX, event.clientY, {...turn}]; };
  picture.onpointermove = (event) => {
    if (!from || plane !== '3-D') return;
    turn.azimuth = from[2].azimuth + (event.clientX - from[0]) / 150;
    turn.height = from[2].height + (event.clientY - from[1]) / 150;
    requestAnimationFrame(drawPicture);
  };
  window.addEventListener('pointerup', () => { from = null; });
  window.addEventListener('resize', () => { drawPicture(); drawMaps(); });
  setInterval(watch, 250);
  connect();
}

start();
