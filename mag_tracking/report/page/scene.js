// The data of a page: columns of tracks, decoded from base64, and how rows are appended live.
'use strict';

const ARRAYS = {f8: Float64Array, f4: Float32Array, u1: Uint8Array};

// A typed array of {f8: base64}, {f4: base64} or {u1: base64}.
function decoded(packed) {
  const [kind] = Object.keys(packed);
  const text = atob(packed[kind]);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[kind](bytes.buffer);
}

// Decode every packed array in nested objects and lists.
function decodedAll(value) {
  if (Array.isArray(value)) return value.map(decodedAll);
  if (value === null || typeof value !== 'object') return value;
  const keys = Object.keys(value);
  if (keys.length === 1 && keys[0] in ARRAYS && typeof value[keys[0]] === 'string') {
    return decoded(value);
  }
  return Object.fromEntries(keys.map(key => [key, decodedAll(value[key])]));
}

function joined(one, other) {
  const out = new one.constructor(one.length + other.length);
  out.set(one);
  out.set(other, one.length);
  return out;
}

// Append the columns of `rows` to those of `track`; a new arrival weighed nothing before.
function append(track, rows) {
  const before = track.columns.t.length, added = rows.columns.t.length;
  for (const name of Object.keys(track.columns)) {
    track.columns[name] = joined(track.columns[name], rows.columns[name]);
  }
  const names = new Set([...Object.keys(track.arrivals), ...Object.keys(rows.arrivals)]);
  for (const name of names) {
    const old = track.arrivals[name] || absent(rows.arrivals[name], before);
    const more = rows.arrivals[name] || absent(old, added);
    track.arrivals[name] = Object.fromEntries(
      Object.keys(old).map(key => [key, joined(old[key], more[key])]));
  }
  track.fields.forEach((field, i) => {
    for (const key of ['measured', 'predicted']) {
      field[key] = field[key].map((axis, a) => joined(axis, rows.fields[i][key][a]));
    }
  });
  track.doubts = track.doubts.concat(rows.doubts);
  track.ended = rows.ended;
  track.facts = rows.facts;
}

function absent(like, n) {
  return Object.fromEntries(Object.keys(like).map(
    key => [key, new like[key].constructor(n).fill(key === 'weight' ? 0 : NaN)]));
}

// The index of the last time that is not later than `t`; -1 before the first.
function indexAt(times, t) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t + 1e-9) low = middle + 1; else high = middle;
  }
  return low - 1;
}

const beginOf = track => track.columns.t[0];
const endOf = track => track.columns.t[track.columns.t.length - 1];

// How long the last pose of a track is shown where none follows [s].
const SHOWN_AFTER_S = 0.6;

// The tracks that have a pose at `t`.
function tracksAt(scene, t) {
  return scene.tracks.filter(
    track => beginOf(track) <= t + 1e-9 && t <= endOf(track) + SHOWN_AFTER_S);
}

// The track whose curves are drawn at `t`: the newest there, else the nearest in time.
function currentTrack(scene, t) {
  const there = tracksAt(scene, t);
  if (there.length) return there[there.length - 1];
  const away = track => Math.max(beginOf(track) - t, t - endOf(track));
  return scene.tracks.reduce(
    (best, track) => best === null || away(track) < away(best) ? track : best, null);
}

// Plotly reads a few tags in its texts; a name is to be shown as it is.
function plain(text) {
  return String(text).replace(/&/g, '&amp;').replace(/</g, '&lt;').replace(/>/g, '&gt;');
}
