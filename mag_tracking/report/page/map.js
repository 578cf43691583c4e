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
const FONT = {size: 13, color: '#1b1b1b'};
// The buttons are listed, because Plotly adds buttons of its own, such as the upload of a chart to a
// server. Without an address, no upload is possible.
const CONFIG = {responsive: true, displaylogo: false, plotlyServerURL: '', showSendToCloud: false,
  modeBarButtons: [['toImage'], ['zoom2d', 'pan2d'], ['zoomIn2d', 'zoomOut2d', 'resetScale2d']]};

// Outline [xs, ys] of the 90 % region of a position.
function ellipse(x, y, xx, xy, yy) {
  const middle = 0.5 * (xx + yy), half = Math.hypot(0.5 * (xx - yy), xy);
  const long = SCALE_2D * Math.sqrt(Math.max(middle + half, 0));
  const short = SCALE_2D * Math.sqrt(Math.max(middle - half, 0));
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy), xs = [], ys = [];
  for (let i = 0; i <= 48; i++) {
    const u = long * Math.cos(i * Math.PI / 24), v = short * Math.sin(i * Math.PI / 24);
    xs.push(x + u * Math.cos(angle) - v * Math.sin(angle));
    ys.push(y + u * Math.sin(angle) + v * Math.cos(angle));
  }
  return [xs, ys];
}

// {arrival: [colour, dash]} in a fixed order.
function stylesOf(track) {
  return Object.fromEntries(Object.keys(track.arrivals).sort().map(
    (name, i) => [name, [SERIES[i % SERIES.length], DASHES[i % DASHES.length]]]));
}

function line(xs, ys, name, style, more) {
  return {type: 'scatter', mode: 'lines', x: xs, y: ys, name: name, line: style,
    hoverinfo: name ? 'name' : 'skip', showlegend: Boolean(name), ...more};
}

// Labels of the sensors; sensors one above the other share a label.
function labelsOf(sensors, factor) {
  const groups = new Map();
  sensors.names.forEach((name, j) => {
    const place = `${(factor * sensors.x[j]).toFixed(1)} ${(factor * sensors.y[j]).toFixed(1)}`;
    groups.set(place, [...(groups.get(place) || []), j]);
  });
  const labels = sensors.names.map(() => '');
  for (const [first, ...more] of groups.values()) {
    labels[first] = plain(sensors.names[first]) + (more.length ? ` +${more.length}` : '');
  }
  return labels;
}

function mapTraces(scene, t) {
  const f = scene.scale.factor, scaled = values => Array.from(values, v => f * v);
  const traces = [], current = currentTrack(scene, t);
  for (const track of tracksAt(scene, t).concat(current ? [current] : [])
    .filter((track, i, all) => all.indexOf(track) === i)) {
    const c = track.columns, k = Math.max(0, indexAt(c.t, t)), first = track === current;
    const named = name => first ? name : '';
    if (track.truth) {
      traces.push(line(scaled(track.truth.x), scaled(track.truth.y), named('truth'),
        {color: '#666666', width: 1.5, dash: 'dash'}));
    }
    if (track.smoothed) {
      traces.push(line(scaled(track.smoothed.x), scaled(track.smoothed.y), named('smoothed'),
        {color: VERMILLION, width: 1.5}));
    }
    // Ambiguous poses may jump, so they are not connected by a line.
    const sure = axis => Array.from(axis, (v, i) => c.ambiguous[i] ? null : f * v);
    const doubtful = axis => scaled(axis.slice(0, k + 1).filter((_, i) => c.ambiguous[i]));
    traces.push(line(sure(c.x), sure(c.y), '', {color: '#a8a8a8', width: 1.5}));
    traces.push(line(sure(c.x).slice(0, k + 1), sure(c.y).slice(0, k + 1),
      named('track'), {color: BLACK, width: 2.5}));
    traces.push({type: 'scatter', mode: 'markers', x: doubtful(c.x), y: doubtful(c.y),
      name: 'ambiguous poses', hoverinfo: 'skip', showlegend: first && c.ambiguous.includes(1),
      marker: {size: 5, color: '#ffffff', line: {color: '#707070', width: 1.2}}});
    if (tracksAt(scene, t).includes(track)) traces.push(...nowTraces(track, k, f, named));
  }
  traces.push({type: 'scatter', mode: scene.sensors.names.length > MAX_LABELS ? 'markers'
    : 'markers+text', x: scaled(scene.sensors.x), y: scaled(scene.sensors.y),
  text: labelsOf(scene.sensors, f), hovertext: scene.sensors.names.map(plain),
  textposition: 'top center', hoverinfo: 'text', name: 'magnetometers', cliponaxis: false,
  marker: {symbol: 'triangle-up', size: 11, color: '#333333'}});
  return traces;
}

// Hypotheses, 90 % region, pose and velocity of a track.
function nowTraces(track, k, f, named) {
  const c = track.columns, traces = [], styles = stylesOf(track);
  const arrivals = Object.entries(track.arrivals).filter(
    ([name, a]) => name !== '' && a.weight[k] > MIN_DRAWN);
  for (const [name, a] of arrivals) {
    const [colour, dash] = styles[name];
    const [xs, ys] = ellipse(f * a.x[k], f * a.y[k], f * f * a.xx[k], f * f * a.xy[k],
      f * f * a.yy[k]);
    traces.push(line(xs, ys, named(`from ${plain(name)}, ${Math.round(100 * a.weight[k])} %`),
      {color: colour, width: 1 + 2 * a.weight[k], dash: dash}));
    traces.push({type: 'scatter', mode: 'markers', x: [f * a.x[k]], y: [f * a.y[k]],
      showlegend: false, hoverinfo: 'skip',
      marker: {symbol: 'cross-thin', size: 9, line: {color: colour, width: 2}}});
  }
  const [xs, ys] = ellipse(f * c.x[k], f * c.y[k], f * f * c.xx[k], f * f * c.xy[k],
    f * f * c.yy[k]);
  traces.push(line(xs, ys, named('90 % region'), {color: BLACK, width: 1},
    {fill: 'toself', fillcolor: c.ambiguous[k] ? 'rgba(0,0,0,0.05)' : 'rgba(0,0,0,0.16)'}));
  traces.push(line([f * c.x[k], f * (c.x[k] + c.vx[k])], [f * c.y[k], f * (c.y[k] + c.vy[k])],
    '', {color: BLACK, width: 1.5, dash: 'dot'}));
  traces.push({type: 'scatter', mode: 'markers', x: [f * c.x[k]], y: [f * c.y[k]],
    name: c.ambiguous[k] ? 'pose (ambiguous)' : 'pose', showlegend: false,
    hoverinfo: 'x+y', meta: 'pose', marker: {size: 11, symbol: 'circle',
      color: c.ambiguous[k] ? '#ffffff' : BLACK, line: {color: BLACK, width: 2}}});
  return traces;
}

function mapLayout(scene) {
  const unit = scene.scale.unit, f = scene.scale.factor, r = scene.reach;
  const axis = (title, low, high) => ({title: {text: `${title} [${unit}]`}, zeroline: false,
    range: [f * low, f * high], gridcolor: '#e3e3e3', exponentformat: 'none', automargin: true});
  return {font: FONT, margin: {l: 55, r: 10, t: 25, b: 45}, uirevision: `${scene.begin_ns} ${scene.sensors.names.join(' ')}`, hovermode: 'closest',
    xaxis: {...axis('x', r[0], r[1]), constrain: 'range'},
    yaxis: {...axis('y', r[2], r[3]), scaleanchor: 'x', constrain: 'range'},
    legend: {orientation: 'h', y: 1.04, yanchor: 'bottom', font: {size: 12}}};
}

// Extend the map to the unambiguous poses of a track, up to a limit.
function extendReach(scene, track) {
  const c = track.columns, r = scene.reach, edge = scene.most_reach;
  for (let k = 0; k < c.t.length; k++) {
    if (c.ambiguous[k]) continue;
    r[0] = Math.max(Math.min(r[0], c.x[k]), edge[0]);
    r[1] = Math.min(Math.max(r[1], c.x[k]), edge[1]);
    r[2] = Math.max(Math.min(r[2], c.y[k]), edge[2]);
    r[3] = Math.min(Math.max(r[3], c.y[k]), edge[3]);
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
