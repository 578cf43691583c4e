// Data of a page: decoding, appending live rows, and lookup by time.
'use strict';

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
  return Object.fromEntries(keys.map(key => [key, decodedAll(value[key])]));
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
  const empty = n => [0, 1, 2].map(() => new Float32Array(n).fill(NaN));
  const both = (a, b) => a.map((axis, i) => joined(axis, b[i]));
  return [...new Set([...old.keys(), ...news.keys()])].sort((a, b) => a - b).map(sensor => {
    const one = old.get(sensor), other = news.get(sensor);
    return {sensor: sensor, t: null,
      measured: both(one ? one.measured : empty(before), other ? other.measured : empty(added)),
      predicted: both(one ? one.predicted : empty(before), other ? other.predicted : empty(added))};
  });
}

// Remove the first `n` poses.
function forget(track, n) {
  const cut = columns => Object.fromEntries(
    Object.entries(columns).map(([name, values]) => [name, values.slice(n)]));
  track.columns = cut(track.columns);
  track.arrivals = Object.fromEntries(
    Object.entries(track.arrivals).map(([name, columns]) => [name, cut(columns)]));
  for (const field of track.fields) {
    for (const key of ['measured', 'predicted']) field[key] = field[key].map(axis => axis.slice(n));
  }
  track.doubts = track.doubts.slice(n);
}

// Columns of an arrival direction for `n` poses that have no hypothesis from this direction.
function absent(like, n) {
  return Object.fromEntries(Object.keys(like).map(
    key => [key, new like[key].constructor(n).fill(key === 'weight' ? 0 : NaN)]));
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
