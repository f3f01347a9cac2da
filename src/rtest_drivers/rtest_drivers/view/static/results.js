// Location errors with what the identifier warns of, and the verdict on the model.
import {cell} from './connection.js';
import {byId, element, number, rows, set} from './dom.js';

// What stands on this card, by names of parts.
export const RESULTS = ['location', 'warnings', 'notes', 'gap', 'gap_notes'];
const LEVELS = {'no gap': 'ok', explained: 'ok', 'partly explained': 'warn'};

export function drawResults() {
  const found = cell.parts.location;
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
  const warnings = cell.parts.warnings || [];
  const list = rows(byId('warnings'), warnings.length, () => element('li'));
  warnings.forEach((text, index) => set(list[index], text));
  byId('warnings').hidden = !warnings.length;
  const notes = cell.parts.notes || [];
  rows(byId('notes'), notes.length, () => element('li'))
    .forEach((one, index) => set(one, notes[index]));
  drawGap();
}

function drawGap() {
  const gap = cell.parts.gap, box = byId('gap');
  box.replaceChildren();
  if (!gap) {
    box.append(element('p', 'quiet', 'The model is compared with the measurement some seconds ' +
      'after a cycle.'));
    return;
  }
  const cycles = Object.keys(cell.parts).filter((name) => name.startsWith('cycle:'));
  const last = cycles.map((name) => cell.parts[name]).find((one) => one.ended === gap.ended);
  const line = element('h3', '',
    `Model against measurement${last ? `, up to ${last.cycle}` : ''}: `);
  line.append(element('span', `badge ${LEVELS[gap.verdict] || 'error'}`, gap.verdict));
  const after = gap.effects.length ?
    `; with the effects below ${number(gap.after, 2)} µm` : '; no known effect was added';
  box.append(line, element('p', 'quiet',
    `The model, which has no error maps, leaves ${number(gap.before, 2)} µm rms, ` +
    `of which ${number(gap.noise, 2)} µm are noise${after}.`));
  const told = paragraphs(cell.parts.gap_notes || []);
  const list = element('ul', 'notes');
  for (const effect of gap.effects) {
    // The identifier's words say more of an effect than its message.
    if (!told.some(([first]) => first.startsWith(`${effect.key}: `))) list.append(brief(effect));
  }
  for (const [first, ...more] of told) {
    const item = element('li', '', first);
    item.append(...more.map((text) => element('p', 'quiet', text)));
    list.append(item);
  }
  box.append(list);
}

// Lines of the identifier: one that is indented belongs to the one before it.
function paragraphs(lines) {
  const made = [];
  for (const text of lines) {
    if (text.startsWith(' ') && made.length) made[made.length - 1].push(text.trim());
    else made.push([text]);
  }
  return made;
}

function brief({key, confidence, rivals}) {
  const others = rivals ? `; cannot be told from ${rivals}` : '';
  return element('li', '', `${key} (${Math.round(100 * confidence)} % sure${others})`);
}
