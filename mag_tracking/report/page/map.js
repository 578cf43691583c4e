// Map of sensors, tracks, 90 % regions and hypotheses at the current time.
'use strict';

// Colours of Okabe and Ito (2008); each has its own dash style.
const SERIES = ['#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9'];
const DASHES = ['solid', 'dash', 'dot', 'dashdot', 'longdash'];
const VERMILLION = '#D55E00', BLACK = '#000000';
const SYMBOLS = ['circle', 'square', 'diamond'];
// Radius of a 90 % ellipse and half width of a 90 % interval, in standard deviations.
const SCALE_2D = Math.sqrt(-2 * Math.log(0.1)), SCALE_1D = 1.645;
// Minimum weight of a hypothesis that is drawn, and maximum number of sensors with labels.
const MIN_DRAWN = 0.01, MAX_LABELS = 24;
// A touch screen has no pointer that hovers, and a drag scrolls the page.
const IS_TOUCHED = matchMedia('(hover: none)').matches;
const FONT = {size: 13, color: '#1b1b1b'};
// Width of the right margin, which contains the buttons [px].
const BUTTONS_PX = 34;
const LAYOUT = {font: FONT, hovermode: 'closest', dragmode: IS_TOUCHED ? false : 'zoom',
  modebar: {orientation: 'v', bgcolor: 'rgba(0,0,0,0)'}};
// The buttons are listed, because Plotly adds buttons of its own, such as the upload of a chart to a
// server. Without an address, no upload is possible.
const CONFIG = {responsive: true, displaylogo: false,
  displayModeBar: IS_TOUCHED ? false : 'hover', plotlyServerURL: '', showSendToCloud: false,
  modeBarButtons: [['toImage'], ['zoom2d', 'pan2d'], ['zoomIn2d', 'zoomOut2d', 'resetScale2d']]};

const scaled = (values, f) => Array.from(values, v => f * v);

// 90 % region of the position in row `k` of columns; `axis` is 'y', or 'z' in the side view.
function regionTrace(c, k, f, axis, name, style, more) {
  const xx = c.xx[k], xy = c[`x${axis}`][k], yy = c[axis + axis][k];
  const middle = 0.5 * (xx + yy), half = Math.hypot(0.5 * (xx - yy), xy);
  const long = SCALE_2D * Math.sqrt(Math.max(middle + half, 0));
  const short = SCALE_2D * Math.sqrt(Math.max(middle - half, 0));
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy), xs = [], ys = [];
  for (let i = 0; i <= 48; i++) {
    const u = long * Math.cos(i * Math.PI / 24), v = short * Math.sin(i * Math.PI / 24);
    xs.push(f * (c.x[k] + u * Math.cos(angle) - v * Math.sin(angle)));
    ys.push(f * (c[axis][k] + u * Math.sin(angle) + v * Math.cos(angle)));
  }
  return line(xs, ys, name, style, more);
}

// {arrival: [colour, dash]} of all tracks, in a fixed order.
function stylesOf(scene) {
  const names = new Set(scene.tracks.flatMap(track => Object.keys(track.arrivals)));
  return Object.fromEntries([...names].sort().map(
    (name, i) => [name, [SERIES[i % SERIES.length], DASHES[i % DASHES.length]]]));
}

function line(xs, ys, name, style, more) {
  return {type: 'scatter', mode: 'lines', x: xs, y: ys, name: name, line: style,
    hoverinfo: name ? 'name' : 'skip', showlegend: Boolean(name), ...more};
}

// Labels of the sensors; sensors at one place of the map share a label.
function labelsOf(x, y, sensors) {
  const groups = new Map();
  sensors.names.forEach((name, j) => {
    const place = `${x[j].toFixed(1)} ${y[j].toFixed(1)}`;
    groups.set(place, [...(groups.get(place) || []), j]);
  });
  const labels = sensors.names.map(() => '');
  for (const [first, ...more] of groups.values()) {
    labels[first] = plain(sensors.names[first]) + (more.length ? ` +${more.length}` : '');
  }
  return labels;
}

// Sensors on a map whose vertical axis is 'y', or 'z' in the side view.
function sensorTrace(scene, f, vertical) {
  const sensors = scene.sensors, x = scaled(sensors.x, f), y = scaled(sensors[vertical], f);
  return {type: 'scatter', mode: sensors.names.length > MAX_LABELS ? 'markers' : 'markers+text',
    x: x, y: y, text: labelsOf(x, y, sensors), hovertext: sensors.names.map(plain),
    textposition: 'top center', hoverinfo: 'text', name: 'magnetometers', cliponaxis: false,
    marker: {symbol: 'triangle-up', size: 11, color: '#333333'}};
}

// Paths of a track up to pose `k`; `axis` is 'y', or 'z' in the side view.
function pathTraces(track, k, f, named, axis) {
  const c = track.columns, traces = [];
  for (const [name, style] of [['truth', {color: '#666666', width: 1.5, dash: 'dash'}],
    ['smoothed', {color: VERMILLION, width: 1.5}]]) {
    const path = track[name];
    if (path) traces.push(line(scaled(path.x, f), scaled(path[axis], f), named(name), style));
  }
  // Ambiguous poses may jump, so they are not connected by a line.
  const sure = values => Array.from(values, (v, i) => c.ambiguous[i] ? null : f * v);
  const doubtful = values => scaled(
    values.slice(0, k + 1).filter((_, i) => c.ambiguous[i]), f);
  traces.push(line(sure(c.x), sure(c[axis]), '', {color: '#a8a8a8', width: 1.5}));
  traces.push(line(sure(c.x).slice(0, k + 1), sure(c[axis]).slice(0, k + 1),
    named('track'), {color: BLACK, width: 2.5}));
  traces.push({type: 'scatter', mode: 'markers', x: doubtful(c.x), y: doubtful(c[axis]),
    name: 'ambiguous poses', hoverinfo: 'skip',
    showlegend: Boolean(named('x')) && c.ambiguous.includes(1),
    marker: {size: 5, color: '#ffffff', line: {color: '#707070', width: 1.2}}});
  return traces;
}

function mapTraces(scene, t) {
  const f = scene.scale.factor, traces = roadTraces(scene, f), current = currentTrack(scene, t);
  const reach = reachAt(scene, current).map;
  const there = tracksAt(scene, t);
  for (const track of new Set(current ? [...there, current] : there)) {
    const k = Math.max(0, indexAt(track.columns.t, t)), named = name => track === current ? name : '';
    traces.push(...pathTraces(track, k, f, named, 'y'), ...timeMarks(track, reach, f));
    if (there.includes(track)) traces.push(...nowTraces(scene, track, k, f, named));
  }
  traces.push(sensorTrace(scene, f, 'y'));
  return traces;
}

// Hypotheses, 90 % region, body, pose and velocity of a track.
function nowTraces(scene, track, k, f, named) {
  const c = track.columns, traces = [], styles = stylesOf(scene);
  const arrivals = Object.entries(track.arrivals).filter(
    ([name, a]) => name !== '' && a.weight[k] > MIN_DRAWN);
  for (const [name, a] of arrivals) {
    const [colour, dash] = styles[name];
    traces.push(regionTrace(a, k, f, 'y',
      named(`from ${plain(name)}, ${Math.round(100 * a.weight[k])} %`),
      {color: colour, width: 1 + 2 * a.weight[k], dash: dash}));
    traces.push({type: 'scatter', mode: 'markers', x: [f * a.x[k]], y: [f * a.y[k]],
      showlegend: false, hoverinfo: 'skip',
      marker: {symbol: 'cross-thin', size: 9, line: {color: colour, width: 2}}});
  }
  traces.push(regionTrace(c, k, f, 'y', named('90 % region'), {color: BLACK, width: 1},
    {fill: 'toself', fillcolor: c.ambiguous[k] ? 'rgba(0,0,0,0.05)' : 'rgba(0,0,0,0.16)'}));
  traces.push(...bodyTraces(scene.reach.map, c, k, f, named, 'y'));
  traces.push({type: 'scatter', mode: 'lines+markers', x: [f * c.x[k], f * (c.x[k] + c.vx[k])],
    y: [f * c.y[k], f * (c.y[k] + c.vy[k])], name: named('path in the next second'),
    showlegend: Boolean(named('x')), hoverinfo: 'skip', line: {color: BLACK, width: 1.5, dash: 'dot'},
    marker: {symbol: ['circle', 'arrow'], size: [0, 12], angleref: 'previous', color: BLACK}});
  traces.push({type: 'scatter', mode: 'markers', x: [f * c.x[k]], y: [f * c.y[k]],
    name: c.ambiguous[k] ? 'pose (ambiguous)' : 'pose', showlegend: false,
    hoverinfo: 'x+y', meta: 'pose', marker: {size: 7, symbol: 'circle',
      color: c.ambiguous[k] ? '#ffffff' : BLACK, line: {color: BLACK, width: 2}}});
  return traces;
}

// Layout of a map with the extent [x0, x1, y0, y1] [m]; the vertical axis is y or z. A zoom by the
// user is kept while `id` is unchanged.
function mapLayout(scene, reach, id, vertical = 'y') {
  const unit = scene.scale.unit, f = scene.scale.factor;
  const axis = (name, from, to) => ({title: {text: `${name} [${unit}]`}, zeroline: false,
    range: [f * from, f * to], gridcolor: '#e3e3e3', exponentformat: 'none', automargin: true});
  return {...LAYOUT, showlegend: false, margin: {l: 55, r: BUTTONS_PX, t: 10, b: 45},
    uirevision: `${scene.begin_ns} ${scene.sensors.names.join(' ')} ${id}`,
    xaxis: {...axis('x', reach[0], reach[1]), constrain: 'range'},
    yaxis: {...axis(vertical, reach[2], reach[3]), scaleanchor: 'x', constrain: 'range'}};
}

// Extents [x0, x1, y0, y1] of the map and [x0, x1, z0, z1] of the side view that hold the bodies and
// 90 % regions of the unambiguous poses of a track, up to a limit.
function extendReach(scene, reach, track) {
  const c = track.columns;
  for (let k = 0; k < c.t.length; k++) {
    if (c.ambiguous[k]) continue;
    const half = variance => Math.max(SCALE_2D * Math.sqrt(variance), bodyRadius(c.length[k]));
    hold(reach.map, 0, c.x[k], half(c.xx[k]), scene.most_reach);
    hold(reach.map, 2, c.y[k], half(c.yy[k]), scene.most_reach);
    hold(reach.side, 2, c.z[k], half(c.zz[k]), scene.most_side);
  }
  reach.side.splice(0, 2, reach.map[0], reach.map[1]);
}

const copyOf = reach => ({map: [...reach.map], side: [...reach.side]});

// A live page keeps its extent, and a report shows the whole current track.
function reachAt(scene, track) {
  if (page.live || !track) return scene.reach;
  if (!track.reach) {
    track.reach = copyOf(scene.network_reach);
    extendReach(scene, track.reach, track);
  }
  return track.reach;
}

// Fractions of a range: distance from its end at which it is extended, and margin beyond the value. The
// margin of a live page is larger, so that a pass changes it once at most.
const NEAR_END = 0.02, MARGIN = 0.1, LIVE_STEP = 0.4;

// Extend the range from `range[i]` to `range[i + 1]` to `value` ± `half` with a margin, up to `edge`.
function hold(range, i, value, half, edge) {
  const span = range[i + 1] - range[i], margin = (page.live ? LIVE_STEP : MARGIN) * span;
  if (value - half < range[i] + NEAR_END * span) {
    range[i] = Math.min(range[i], Math.max(value - half - margin, edge[i]));
  }
  if (value + half > range[i + 1] - NEAR_END * span) {
    range[i + 1] = Math.max(range[i + 1], Math.min(value + half + margin, edge[i + 1]));
  }
}

function readout(scene, t) {
  const there = tracksAt(scene, t);
  if (!there.length) return 'No target at this time.';
  return there.map(track => {
    const c = track.columns, k = indexAt(c.t, t), f = scene.scale.factor, u = scene.scale.unit;
    const sd = f * Math.sqrt(c.xx[k] + c.yy[k]), digits = u === 'm' ? 2 : 1;
    return `Track ${track.id}: x ${(f * c.x[k]).toFixed(digits)}, y ` +
      `${(f * c.y[k]).toFixed(digits)}, z ${(f * c.z[k]).toFixed(digits)} ${u}; standard deviation ` +
      `${sd.toFixed(digits)} ${u}; ${(f * Math.hypot(c.vx[k], c.vy[k])).toFixed(digits)} ${u}/s` +
      (c.ambiguous[k] ? `; ambiguous (${track.doubts[k].replaceAll('_', ' ') || 'no reason given'})`
        : '');
  }).join('\n');
}
