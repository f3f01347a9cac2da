// Wishes to the session and marks in the recording.
import {byId, set} from './dom.js';

const KEY = document.querySelector('meta[name=rtest-key]').content || location.hash.slice(1);
const NO_CONNECTION = 'No connection to the server: buttons are off until it is back.';
const SURE_MS = 4000;
// An answer that stays looks like the state of the session [ms].
const ANSWER_MS = 20_000;

// Why buttons are off for good, '' where they are not.
let off = KEY ? '' :
  'Looking only: buttons need the address with its key, as rtest view printed it.';
let connected = false, fading;

export function startControls() {
  for (const button of document.querySelectorAll('[data-wish]')) {
    button.onclick = () => onWish(button);
  }
  byId('mark').onsubmit = async (event) => {
    event.preventDefault();
    if (await post('/mark', {text: byId('mark-text').value})) byId('mark-text').value = '';
  };
  // An address with another key, typed on this page, loads nothing by itself.
  window.addEventListener('hashchange', () => location.reload());
  permit(false);
}

// Buttons can be tapped only where their wish can arrive; else they say why not.
export function permit(there) {
  connected = there;
  const why = off || (connected ? '' : NO_CONNECTION);
  for (const button of document.querySelectorAll('footer button')) {
    if (why && !button.disabled) calm(button);
    button.disabled = Boolean(why);
    button.title = why;
  }
  // A tablet shows no titles.
  set(byId('why-off'), why);
}

function say(text, level) {
  set(byId('answer'), text, level);
  clearTimeout(fading);
  if (level) fading = setTimeout(() => say('', ''), ANSWER_MS);
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
    if (response.status === 403) {
      // The server does not know the key, it will not know it later.
      off = answer.answer;
      permit(connected);
    }
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
  button.timer = setTimeout(() => calm(button), SURE_MS);
}

function calm(button) {
  if (!button.classList.contains('sure')) return;
  clearTimeout(button.timer);
  button.classList.remove('sure');
  button.textContent = button.dataset.label;
}
