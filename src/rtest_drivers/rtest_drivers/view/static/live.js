// What is now: session, devices, axes, sphere, recording.
import {cell} from './connection.js';
import {drawBar, newBar} from './gauges.js';
import {WORDS, byId, element, number, rows, set} from './dom.js';

export function drawLive() {
  drawSession();
  drawDevices();
  drawAxes();
  drawSphere();
  drawRecording();
}

function drawSession() {
  const session = cell.live.session;
  set(byId('session'), session.name || 'R-test cell');
  const place = session.cycles ? `cycle ${session.cycle} of ${session.cycles}: ` : '';
  set(byId('doing'), place + session.text);
  // What the session waits for stands out.
  const start = document.querySelector('[data-wish=start]');
  start.classList.toggle('chosen', Boolean(session.waits));
  // What is measured while something does not work is asked for twice.
  const broken = cell.live.devices.filter((one) => one.level === 'error').map((one) => one.name);
  if (broken.length) start.dataset.sure = `start although ${broken.join(', ')}: ERROR`;
  else delete start.dataset.sure;
}

function drawDevices() {
  const devices = cell.live.devices;
  const made = rows(byId('devices').tBodies[0], devices.length, () => {
    const row = element('tr');
    row.append(element('th'), element('td'), element('td'), element('td', 'number'));
    row.children[1].append(element('span'));
    return row;
  });
  devices.forEach((one, index) => {
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

function drawAxes() {
  const axes = cell.live.axes;
  const made = rows(byId('axes'), axes.length, () => {
    const row = element('div', 'axis'), value = element('div', 'value');
    value.append(element('span', 'figure'), element('span', 'unit'));
    row.append(element('b'), newBar(), value);
    return row;
  });
  axes.forEach((one, index) => {
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
  const sphere = cell.live.sphere;
  const made = rows(byId('sphere'), 3, (index) => {
    const one = element('span', 'value');
    one.append(element('span', 'unit', 'XYZ'[index] + ' '), element('span', 'figure'),
      element('span', 'unit', ' µm'));
    return one;
  });
  made.forEach((one, index) => {
    set(one.children[1], sphere ? number(sphere[index], 2) : '–');
  });
}

function bytes(value) {
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  let left = Number(value), unit = 0;
  while (left >= 1000 && unit < units.length - 1) { left /= 1000; unit += 1; }
  return `${left.toFixed(unit ? 1 : 0)} ${units[unit]}`;
}

function drawRecording() {
  const one = cell.live.recording, marks = cell.parts.marks || [];
  const lines = [['state', `${WORDS[one.level]}: ${one.text}`]];
  if (one.bytes) lines.push(['size', bytes(one.bytes)]);
  if (one.disk_free) lines.push(['disk left', bytes(one.disk_free)]);
  if (one.lost) {
    lines.push(['lost', one.lost === '0' ? 'nothing' : `${one.lost} readings or messages`]);
  }
  if (one.file) lines.push(['file', one.file.split('/').pop()]);
  if (marks.length) lines.push(['last mark', marks[marks.length - 1]]);
  const made = rows(byId('recording'), 2 * lines.length,
    (index) => element(index % 2 ? 'dd' : 'dt'));
  lines.forEach(([name, text], index) => {
    set(made[2 * index], name);
    set(made[2 * index + 1], text,
      name === 'state' || (name === 'lost' && one.lost !== '0') ? `badge ${one.level}` : '');
  });
}
