// State of the page and current time. A live page receives its data through live.js.
'use strict';

const page = {scene: null, t: 0, follows: false, choice: STRONGEST, current: undefined,
  plays: false, drawn: 0, tableDue: 0};
// Intervals between updates of the track table and of the curves of a live page [ms].
const TABLE_MS = 1000, CURVES_MS = 250;
// Width and height of the axis labels and margins of a map [px].
const MAP_FRAME_PX = 90;
// Margin of a live map and maximum height of the side view, relative to the extent of the map.
const LIVE_MARGIN = 0.3, MAX_HEIGHT = 0.5;
// Public for debugging and tests.
window.magTracking = page;

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
  const z = Array.from(scene.sensors.z);
  const side = ([x0, x1, y0, y1], n) => [x0, x1, Math.min(...z) - n * Math.max(x1 - x0, y1 - y0),
    Math.max(...z) + n * Math.max(x1 - x0, y1 - y0)];
  scene.network_reach = {map: scene.reach, side: side(scene.reach, MARGIN)};
  scene.most_side = side(scene.most_reach, MAX_HEIGHT);
  scene.reach = copyOf(scene.network_reach);
  if (page.live) {
    // The targets are still to come.
    scene.reach.map = scene.reach.map.map((v, i) => v + LIVE_MARGIN * (scene.most_reach[i] - v));
  }
  scene.tracks.forEach(track => extendReach(scene, scene.reach, track));
  at('scene').hidden = at('time').hidden = false;
  at('sensors').replaceChildren(
    element('option', `${MAX_PANELS} strongest`, {value: STRONGEST}),
    ...scene.sensors.names.map(name => element('option', name, {value: name})));
  if (!scene.sensors.names.includes(page.choice)) page.choice = STRONGEST;
  at('sensors').value = page.choice;
  page.current = undefined;
  page.tableDue = 0;
  showPanels(scene);
  if (!page.live) fitMaps(scene);
  boundSlider();
  const first = scene.tracks[0];
  moveTo(page.follows ? scene.end : first ? mostAccurateTime(first) : 0);
}

// Show the panels that have a content. The last one of an odd number is wide.
function showPanels(scene) {
  const tracks = scene.tracks, contents = {
    map: true, overview: !page.live && tracks.length >= MIN_TRACKS, side: tracks.some(isMagnet),
    field: page.live || tracks.some(track => track.fields.length),
    weights: tracks.some(track => Object.keys(track.arrivals).some(Boolean)),
    innovation: tracks.some(track => !track.columns.nis.every(Number.isNaN)),
    speed: tracks.length > 0};
  for (const row of [['map', 'overview', 'side', 'field'], ['weights', 'innovation', 'speed']]) {
    const shown = row.filter(name => contents[name]);
    for (const name of row) {
      const card = at(`${name}-card`), is_wide = name === shown.at(-1) && shown.length % 2 === 1;
      card.hidden = !contents[name];
      card.classList.toggle('wide', is_wide);
    }
  }
}

// Set the height of the maps of a report to the median of their contents, within limits of the style.
function fitMaps(scene) {
  const ratios = [scene.reach, ...scene.tracks.map(track => reachAt(scene, track))]
    .map(({map: [x0, x1, y0, y1]}) => (y1 - y0) / (x1 - x0)).sort((a, b) => a - b);
  const height = MAP_FRAME_PX + ratios[ratios.length >> 1] * (at('map').clientWidth - MAP_FRAME_PX);
  at('scene').style.setProperty('--map-height', `${Math.round(height)}px`);
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
  if (page.follows && (!track || t <= endOf(track) + SHOWN_AFTER_S)) {
    const from = Math.max(page.scene.begin, t - WINDOW_S);
    return [from, from + WINDOW_S];
  }
  if (!track) return [t - WINDOW_S, t];
  const margin = 0.03 * (endOf(track) - beginOf(track)) + 0.01;
  return [beginOf(track) - margin, endOf(track) + margin];
}

let curvesDue = 0, lastCurves = null;
function draw() {
  const scene = page.scene, t = page.t, track = currentTrack(scene, t);
  at('slider').value = t;
  at('clock').textContent = `${t.toFixed(2)} s`;
  at('latest').hidden = !page.live || page.follows;
  at('readout').textContent = readout(scene, t);
  const traces = mapTraces(scene, t);
  Plotly.react('map', traces,
    mapLayout(scene, reachAt(scene, track).map, page.live || track?.key), CONFIG);
  showLegend('map-legend', traces);
  drawSide(scene, track, t);
  const key = track ? track.key : null;
  if (page.follows ? performance.now() > curvesDue : key !== page.current) {
    drawCurves(track, t);
    drawOverview(scene, track);
    if (page.follows) curvesDue = performance.now() + CURVES_MS;
    clearTimeout(lastCurves);
  } else if (page.follows) {
    // The curves of the last message, if no other message follows.
    clearTimeout(lastCurves);
    lastCurves = setTimeout(() => moveTo(page.t), CURVES_MS);
  } else {
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
  // On a live page, the fields are always those of the latest seconds.
  drawFields(page.scene, track, page.choice, t, page.follows ? rangeOf(null, t) : range);
  if (!track) return;
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
