// State of the page and current time. A live page receives its data through live.js.
'use strict';

const page = {scene: null, t: 0, follows: false, choice: STRONGEST, current: undefined,
  plays: false, drawn: 0, tableDue: 0};
// Interval between updates of the track table of a live page [ms].
const TABLE_MS = 1000;
// Public for debugging and tests.
window.magTracking = page;

const at = id => document.getElementById(id);

function begin(data) {
  at('title').textContent = data.title;
  at('subtitle').textContent = data.subtitle || '';
  showNotes(data.notes || []);
  showTables(data.tables || []);
  if (data.charts) showCharts(data.charts);
  if (data.scene) setScene(data.scene);
  if (data.live) connect();
}

function setScene(packed) {
  const scene = page.scene = decodedAll(packed);
  scene.tracks.forEach(track => extendReach(scene, track));
  at('scene').hidden = at('time').hidden = false;
  at('sensors').replaceChildren(
    element('option', `${MAX_PANELS} strongest`, {value: STRONGEST}),
    ...scene.sensors.names.map(name => element('option', name, {value: name})));
  if (!scene.sensors.names.includes(page.choice)) page.choice = STRONGEST;
  at('sensors').value = page.choice;
  page.current = undefined;
  page.tableDue = 0;
  // Fitted passes have neither weights nor innovations.
  at('weights-card').hidden = !page.live && scene.tracks.every(
    track => !Object.keys(track.arrivals).length);
  at('innovation-card').hidden = !page.live && scene.tracks.every(
    track => track.columns.nis.every(Number.isNaN));
  boundSlider();
  const first = scene.tracks[0];
  moveTo(page.follows ? scene.end : first ? mostAccurateTime(first) : 0);
}

// Time of the most accurate pose of a track.
function mostAccurateTime(track) {
  const c = track.columns;
  let k = 0;
  for (let i = 1; i < c.t.length; i++) {
    if (!c.ambiguous[i] && c.xx[i] + c.yy[i] < c.xx[k] + c.yy[k] || c.ambiguous[k]) k = i;
  }
  return c.t[k];
}

function boundSlider() {
  const scene = page.scene;
  at('slider').min = scene.begin;
  at('slider').max = Math.max(scene.end, scene.begin + 1e-3);
}

// Set the current time; the page is redrawn once per animation frame at most.
let waiting = false;
function moveTo(t) {
  page.t = t;
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    draw();
  });
}

function rangeOf(track, t) {
  if (page.follows) return [Math.max(page.scene.begin, t - WINDOW_S), t];
  if (!track) return [t - WINDOW_S, t];
  const margin = 0.03 * (endOf(track) - beginOf(track)) + 0.01;
  return [beginOf(track) - margin, endOf(track) + margin];
}

let curvesDue = 0;
function draw() {
  const scene = page.scene, t = page.t;
  const nearest = currentTrack(scene, t);
  // While there is no target, a live page shows the current fields.
  const track = page.follows && !tracksAt(scene, t).length ? null : nearest;
  at('slider').value = t;
  at('clock').textContent = `${t.toFixed(2)} s`;
  at('latest').hidden = !page.live || page.follows;
  at('readout').textContent = readout(scene, t);
  Plotly.react('map', mapTraces(scene, t), mapLayout(scene), CONFIG);
  const key = track ? track.key : null;
  if (page.follows ? performance.now() > curvesDue : key !== page.current) {
    drawCurves(track, t);
    if (page.follows) curvesDue = performance.now() + 250;
  } else if (!page.follows) {
    moveLines(t);
  }
  page.current = key;
  if (performance.now() > page.tableDue) {
    showTrackTable(scene, track => jump(track));
    page.tableDue = page.live ? performance.now() + TABLE_MS : Infinity;
  }
  markTrack(key);
  page.drawn += 1;
  page.latestDrawn = scene.latestNs;
}

function drawCurves(track, t) {
  const range = rangeOf(track, t);
  drawFields(page.scene, track, page.choice, t, range);
  drawWeights(track, t, range);
  drawInnovation(track, t, range);
  drawSpeed(track, t, range);
}

function jump(track) {
  page.follows = false;
  page.current = undefined;
  moveTo(mostAccurateTime(track));
  at('map-card').scrollIntoView({block: 'nearest'});
}

function play() {
  page.plays = !page.plays;
  at('play').innerHTML = page.plays ? '&#10074;&#10074;' : '&#9654;';
  at('play').setAttribute('aria-label', page.plays ? 'Pause' : 'Play');
  if (!page.plays) return;
  page.follows = false;
  if (page.t >= page.scene.end) page.t = page.scene.begin;
  let before = performance.now();
  const step = now => {
    if (!page.plays) return;
    const t = page.t + (now - before) / 1000;
    before = now;
    moveTo(Math.min(t, page.scene.end));
    if (t >= page.scene.end) play(); else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
}

at('slider').addEventListener('input', event => {
  page.follows = false;
  moveTo(Number(event.target.value));
});
at('sensors').addEventListener('change', event => {
  page.choice = event.target.value;
  page.current = undefined;
  curvesDue = 0;
  moveTo(page.t);
});
at('play').addEventListener('click', play);
at('latest').addEventListener('click', () => {
  page.follows = true;
  page.current = undefined;
  moveTo(page.scene.end);
});
