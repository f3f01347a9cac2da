// What the server sends: `history` once, `part` when something changed, `live` ten times a second.
// Only the last values are kept; nothing is queued.
import {byId, set} from './dom.js';

// The strip chart reaches back so far [s].
export const HISTORY_S = 60;
// Values are old when nothing came for this long [ms].
const LOST_MS = 1500;

// live : the last record, null before the first; parts : of a name, as `view/state.py` makes them;
// strip : {t [s], spans [µm], sphere [µm]} of the last minute
export const cell = {live: null, parts: {}, strip: []};
let heard = 0;

export function connect(onPart, onLive) {
  const source = new EventSource('/events');
  source.addEventListener('history', (event) => { cell.strip = JSON.parse(event.data); });
  source.addEventListener('part', (event) => {
    const {name, shown} = JSON.parse(event.data);
    if (shown === null) delete cell.parts[name]; else cell.parts[name] = shown;
    onPart(name, shown);
  });
  source.addEventListener('live', (event) => {
    cell.live = JSON.parse(event.data);
    heard = performance.now();
    if (cell.live === null) return;
    const {t, spans, sphere} = cell.live;
    cell.strip.push({t, spans, sphere});
    while (cell.strip.length && cell.strip[0].t < t - HISTORY_S) cell.strip.shift();
    onLive();
  });
}

// Says whether the values are of now; returns whether the server is there.
export function watch() {
  const old = performance.now() - heard, lost = Boolean(heard) && old > LOST_MS;
  document.body.classList.toggle('lost', lost);
  if (!heard) set(byId('link'), 'CONNECTING', 'badge idle');
  else if (lost) {
    set(byId('link'), `NO CONNECTION for ${(old / 1000).toFixed(0)} s: all values are old`,
      'badge error');
  } else set(byId('link'), 'LIVE', 'badge ok');
  return Boolean(heard) && !lost;
}
