// WebSocket client of a live page with automatic reconnection.
'use strict';

const RETRY_MS = 1000;
// History [s].
const KEPT_S = 600;

function connect() {
  page.live = true;
  page.follows = true;
  const token = new URLSearchParams(location.search).get('token');
  const address = new URL('stream' + (token ? `?token=${encodeURIComponent(token)}` : ''),
    location.href);
  address.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
  const socket = new WebSocket(address);
  socket.addEventListener('message', event => take(JSON.parse(event.data)));
  socket.addEventListener('open', () => say('Connected', false));
  socket.addEventListener('close', () => {
    say('Connection lost. Reconnecting…', true);
    setTimeout(connect, RETRY_MS);
  });
}

function say(text, lost) {
  const line = at('connection');
  line.hidden = false;
  line.textContent = text;
  line.className = lost ? 'lost' : '';
  page.connected = !lost;
}

function take(message) {
  if (message.type === 'scene') {
    at('title').textContent = message.title;
    at('subtitle').textContent = message.subtitle;
    setScene(message.scene);
    page.scene.heard = {t: [], fields: [0, 1, 2].map(
      () => page.scene.sensors.names.map(() => []))};
  } else if (message.type === 'rows' && page.scene) {
    takeRows(decodedAll(message));
  } else if (message.type === 'fault') {
    say(`Fault of the page: ${message.text}`, true);
  } else if (message.type === 'health') {
    showNotes(message.notes);
    showTables(message.tables);
  }
}

function takeRows(message) {
  const scene = page.scene;
  for (const rows of message.tracks) {
    const track = scene.tracks.find(other => other.key === rows.key);
    if (track) append(track, rows); else scene.tracks.push(rows);
    grownReach(scene, track || rows);
    if (!track || rows.ended) page.tableDue = 0;
  }
  for (const one of message.smoothed) {
    const track = scene.tracks.find(other => other.key === one.key);
    if (track) track.smoothed = one;
  }
  if (message.frame) hear(scene.heard, message.frame);
  scene.end = Math.max(scene.end, message.end);
  scene.latestNs = message.latest_ns;
  scene.tracks = scene.tracks.filter(track => endOf(track) > scene.end - KEPT_S);
  scene.begin = Math.max(scene.begin, scene.end - KEPT_S);
  boundSlider();
  moveTo(page.follows ? scene.end : page.t);
}

function hear(heard, frame) {
  heard.t.push(frame.t);
  const gone = indexAt(heard.t, frame.t - WINDOW_S) + 1;
  heard.t.splice(0, gone);
  heard.fields.forEach((axis, a) => axis.forEach((values, j) => {
    values.push(frame.field[3 * j + a]);
    values.splice(0, gone);
  }));
}
