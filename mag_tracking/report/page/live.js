// WebSocket client of a live page with automatic reconnection.
'use strict';

const RETRY_MS = 1000;
// Tracks that ended earlier than this are removed [s].
const HISTORY_S = 600;

function connect() {
  page.live = true;
  page.follows = true;
  // The server has stored the token in a cookie. The address must not show it to bystanders.
  if (location.search) history.replaceState(null, '', location.pathname);
  const address = new URL('stream', location.href);
  address.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
  const socket = new WebSocket(address);
  socket.addEventListener('message', event => receive(JSON.parse(event.data)));
  socket.addEventListener('open', () => showConnection('Connected', false));
  socket.addEventListener('close', () => {
    showConnection('Connection lost. Reconnecting…', true);
    setTimeout(connect, RETRY_MS);
  });
}

function showConnection(text, lost) {
  const line = at('connection');
  line.hidden = false;
  line.textContent = text;
  line.className = lost ? 'lost' : '';
  page.connected = !lost;
}

function receive(message) {
  if (message.type === 'scene') {
    at('title').textContent = message.title;
    at('subtitle').textContent = message.subtitle;
    setScene(message.scene);
    page.scene.recent = {t: [], fields: [0, 1, 2].map(
      () => page.scene.sensors.names.map(() => []))};
  } else if (message.type === 'rows' && page.scene) {
    addRows(decodedAll(message));
  } else if (message.type === 'fault') {
    showConnection(`Page error: ${message.text}`, true);
  } else if (message.type === 'health') {
    showNotes(message.notes);
    showTables(message.tables);
  }
}

function addRows(message) {
  const scene = page.scene;
  for (const rows of message.tracks) {
    const track = trackOf(scene, rows.key);
    if (track) append(track, rows); else scene.tracks.push(rows);
    extendReach(scene, scene.reach, rows);
    if (!track) showPanels(scene);
    if (!track || rows.ended) page.tableDue = 0;
  }
  for (const one of message.smoothed) {
    const track = trackOf(scene, one.key);
    if (track) track.smoothed = one;
  }
  for (const frame of message.frames) addFrame(scene.recent, frame);
  scene.end = Math.max(scene.end, message.end);
  scene.latestNs = message.latest_ns;
  scene.tracks = scene.tracks.filter(track => endOf(track) > scene.end - HISTORY_S);
  scene.begin = Math.max(scene.begin, scene.end - HISTORY_S);
  boundSlider();
  moveTo(page.follows ? scene.end : page.t);
}

// Append a frame, and remove the frames that are older than the time axis.
function addFrame(recent, frame) {
  recent.t.push(frame.t);
  const old = indexAt(recent.t, frame.t - WINDOW_S) + 1;
  recent.t.splice(0, old);
  recent.fields.forEach((axis, a) => axis.forEach((values, j) => {
    values.push(frame.field[3 * j + a]);
    values.splice(0, old);
  }));
}
