// The page of a cell: everything is drawn from the last values, at most once a frame.
import {cell, connect, watch} from './connection.js';
import {permit, startControls} from './controls.js';
import {drawGauges} from './gauges.js';
import {drawLive} from './live.js';
import {drawMaps} from './maps.js';
import {drawPicture, startPicture} from './picture.js';
import {drawPoses, forgetCycle} from './poses.js';
import {RESULTS, drawResults} from './results.js';
import {drawStrip, startStrip} from './strip.js';

// How often it is looked whether values still come [ms].
const WATCH_MS = 250;

let drawn = true;

function showPart(name, shown) {
  if (name.startsWith('cycle:')) {
    if (shown === null) forgetCycle();
    drawPoses();
    // The verdict names the last cycle it is of.
    if (cell.parts.gap) drawResults();
  } else if (RESULTS.includes(name)) drawResults();
  else if (name === 'picture') drawPicture();
  else if (name.startsWith('map:')) drawMaps();
}

function showLive() {
  if (!drawn) return;
  drawn = false;
  requestAnimationFrame(draw);
}

function draw() {
  drawn = true;
  if (cell.live === null) return;
  drawLive();
  drawGauges();
  drawStrip();
}

startControls();
startStrip();
startPicture();
window.addEventListener('resize', () => { drawPicture(); drawMaps(); });
setInterval(() => permit(watch()), WATCH_MS);
connect(showPart, showLive);
