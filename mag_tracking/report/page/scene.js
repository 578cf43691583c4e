// Data of a page: decoding, appending live rows, and lookup by time.
'use strict';

const at = id => document.getElementById(id);

const ARRAYS = {f8: Float64Array, f4: Float32Array, u1: Uint8Array};

// Maximum number of poses of a live track, and number removed when it is exceeded.
const MAX_TRACK_POSES = 8000, N_REMOVED = 1000;

// Typed array from {f8: base64}, {f4: base64} or {u1: base64}.
function decoded(packed) {
  const [kind] = Object.keys(packed);
  const text = atob(packed[kind]);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[kind](bytes.buffer);
}

// Decode all packed arrays in nested objects and lists.
function decodedAll(value) {
  if (Array.isArray(value)) return value.map(decodedAll);
  if (value === null || typeof value !== 'object') return value;
  const keys = Object.keys(value);
  if (keys.length === 1 && keys[0] in ARRAYS && typeof value[keys[0]] === 'string') {
    return decoded(value);
  }
  return mapped(value, decodedAll);
}

// Object with the same keys, and the values `change(value, key)`.
function mapped(object, change) {
  return Object.fromEntries(Object.entries(object).map(([key, value]) => [key, change(value, key)]));
}

function joined(one, other) {
  const out = new one.constructor(one.length + other.length);
  out.set(one);
  out.set(other, one.length);
  return out;
}

// Append the columns of `rows` to `track`; a new direction of arrival had weight 0 before.
function append(track, rows) {
  const before = track.columns.t.length, added = rows.columns.t.length;
  track.columns = mapped(track.columns, (values, name) => joined(values, rows.columns[name]));
  track.arrivals = mapped({...track.arrivals, ...rows.arrivals}, (_, name) => {
    const old = track.arrivals[name] || absent(rows.arrivals[name], before);
    const more = rows.arrivals[name] || absent(old, added);
    return mapped(old, (values, key) => joined(values, more[key]));
  });
  track.fields = joinedFields(track.fields, before, rows.fields, added);
  track.doubts = track.doubts.concat(rows.doubts);
  const excess = track.columns.t.length - MAX_TRACK_POSES;
  if (excess > 0) forget(track, excess + N_REMOVED);
  track.ended = rows.ended;
  track.facts = rows.facts;
}

// Concatenate the fields of two lists by sensor; NaN if one list lacks a sensor.
function joinedFields(fields, before, more, added) {
  const bySensor = list => new Map(list.map(field => [field.sensor, field]));
  const old = bySensor(fields), news = bySensor(more);
  const axis = (field, key, a, n) => field ? field[key][a] : new Float32Array(n).fill(NaN);
  return [...new Set([...old.keys(), ...news.keys()])].sort((a, b) => a - b).map(sensor => {
    const both = key => [0, 1, 2].map(a => joined(
      axis(old.get(sensor), key, a, before), axis(news.get(sensor), key, a, added)));
    return {sensor: sensor, t: null, measured: both('measured'), predicted: both('predicted')};
  });
}

// Remove the first `n` poses.
function forget(track, n) {
  const cut = columns => mapped(columns, values => values.slice(n));
  track.columns = cut(track.columns);
  track.arrivals = mapped(track.arrivals, cut);
  for (const field of track.fields) {
    for (const key of ['measured', 'predicted']) field[key] = field[key].map(axis => axis.slice(n));
  }
  track.doubts = track.doubts.slice(n);
}

// Columns of an arrival direction for `n` poses that have no hypothesis from this direction.
function absent(like, n) {
  return mapped(like,
    (values, key) => new values.constructor(n).fill(key === 'weight' ? 0 : NaN));
}

// Index of the last time not after `t`; -1 if all are later.
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

// Time for which the last pose of a track remains on the map [s].
const SHOWN_AFTER_S = 0.6;

// Tracks shown on the map at `t`.
function tracksAt(scene, t) {
  return scene.tracks.filter(
    track => beginOf(track) <= t + 1e-9 && t <= endOf(track) + SHOWN_AFTER_S);
}

const trackOf = (scene, key) => scene.tracks.find(track => track.key === key);

// Track shown in the plots at `t`: the newest track on the map, otherwise the nearest in time.
function currentTrack(scene, t) {
  const there = tracksAt(scene, t);
  if (there.length) return there[there.length - 1];
  const away = track => Math.max(beginOf(track) - t, t - endOf(track));
  return scene.tracks.reduce(
    (best, track) => best === null || away(track) < away(best) ? track : best, null);
}

// Escape the markup characters of Plotly.
function plain(text) {
  return String(text).replace(/&/g, '&amp;').replace(/</g, '&lt;').replace(/>/g, '&gt;');
}

// Inverse of `plain`.
function unescaped(text) {
  return text.replace(/&lt;/g, '<').replace(/&gt;/g, '>').replace(/&amp;/g, '&');
}
