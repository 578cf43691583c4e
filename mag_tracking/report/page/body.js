// Bodies on the maps: road, vehicles to scale, moments of magnets, and marks of time.
'use strict';

// A row of dipoles ends before the bumpers [m].
const OVERHANG_M = 1.3, MIN_LENGTH_M = 2.2;
// Width of a vehicle by the length of its row of dipoles [m].
const WIDTHS_M = [[1.0, 0.8], [5.0, 1.8], [Infinity, 2.5]];
// Length of the moment of a magnet relative to the map, and minimum distance of two time marks [px].
const MOMENT_SIZE = 0.12, MARK_PX = 38;
const MAX_MARKS = 9, MARK_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1800, 3600];

const vehicleLength = length => Math.max(length + OVERHANG_M, MIN_LENGTH_M);

// Distance of the bumpers from the pose of a vehicle; 0 for a magnet [m].
function bodyRadius(length) {
  return Number.isNaN(length) ? 0 : 0.5 * vehicleLength(length);
}

function roadTraces(scene, f) {
  // One trace per area: where areas of one trace overlap, they are not filled.
  return [
    ...scene.road.areas.map(area => line(scaled(area.x, f), scaled(area.y, f), '', {width: 0},
      {fill: 'toself', fillcolor: '#e9e9e7'})),
    ...scene.road.markings.map(mark => line(scaled(mark.x, f), scaled(mark.y, f), '',
      {color: '#ffffff', width: 2.5, dash: '12px,10px'}))];
}

// Outline of a vehicle seen from above, with its windscreen, or the moment of a magnet at pose `k`.
function bodyTraces(reach, c, k, f, named, axis) {
  const size = MOMENT_SIZE * (reach[1] - reach[0]);
  if (Number.isNaN(c.length[k])) {
    const m = Math.hypot(c.mx[k], c.my[k], c.mz[k]);
    return [{type: 'scatter', mode: 'lines+markers', name: named('moment'), hoverinfo: 'skip',
      x: [f * c.x[k], f * (c.x[k] + size * c.mx[k] / m)],
      y: [f * c[axis][k], f * (c[axis][k] + size * c[`m${axis}`][k] / m)],
      showlegend: Boolean(named('x')) && m > 0, line: {color: SERIES[0], width: 3},
      marker: {symbol: ['circle', 'arrow'], size: [0, 14], angleref: 'previous', color: SERIES[0]}}];
  }
  const half = bodyRadius(c.length[k]), side = 0.5 * WIDTHS_M.find(([to]) => c.length[k] < to)[1];
  const angle = Math.atan2(c.vy[k], c.vx[k]), bonnet = half - 0.6 * side, screen = half - 1.5 * side;
  const outline = [[half, 0.6 * side], [bonnet, side], [-half, side], [-half, -side], [bonnet, -side],
    [half, -0.6 * side], [half, 0.6 * side], [null, null], [screen, 0.8 * side], [screen, -0.8 * side]];
  const at = (u, v, x, cos, sin) => u === null ? null : f * (x + u * cos + v * sin);
  return [line(outline.map(([u, v]) => at(u, v, c.x[k], Math.cos(angle), -Math.sin(angle))),
    outline.map(([u, v]) => at(u, v, c.y[k], Math.sin(angle), Math.cos(angle))),
    named('vehicle to scale'), {color: SERIES[0], width: 2},
    {fill: 'toself', fillcolor: 'rgba(0,114,178,0.25)', meta: 'body'})];
}

// Marks at round times along the unambiguous poses of a track.
function timeMarks(track, reach, f) {
  const c = track.columns, marks = {x: [], y: [], text: []}, duration = endOf(track) - beginOf(track);
  const step = MARK_STEPS_S.find(s => duration / s < MAX_MARKS) || duration;
  const distance = MARK_PX / at('map').clientWidth * (reach[1] - reach[0]);
  let before = -1;
  for (let n = Math.ceil(beginOf(track) / step); n * step <= endOf(track); n++) {
    const k = indexAt(c.t, n * step);
    if (c.ambiguous[k] || before >= 0
      && Math.hypot(c.x[k] - c.x[before], c.y[k] - c.y[before]) < distance) continue;
    before = k;
    marks.x.push(f * c.x[k]);
    marks.y.push(f * c.y[k]);
    marks.text.push(`${Number((n * step).toFixed(1))} s`);
  }
  return [{type: 'scatter', mode: 'markers+text', ...marks, hoverinfo: 'skip', showlegend: false,
    textposition: 'bottom center', textfont: {size: 11, color: '#444444'}, meta: 'time',
    marker: {symbol: 'circle', size: 6, color: '#ffffff', line: {color: '#444444', width: 1.5}}}];
}
