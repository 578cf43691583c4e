// Plots over time (fields, weights, innovation, speed) with a line at the current time.
'use strict';

const STRONGEST = 'strongest';
const MAX_PANELS = 4;
// Length of the time axis of a live page [s].
const WINDOW_S = 20;
// Number of readings above which the markers are small.
const DENSE_READINGS = 250;

const AXES = [[VERMILLION, 'solid'], [SERIES[2], 'dash'], [SERIES[0], 'dot']];

function curveLayout(title, t, range, more) {
  return {...LAYOUT, margin: {l: 60, r: BUTTONS_PX, t: 8, b: 40},
    xaxis: {title: {text: 'time [s]'}, range: range, gridcolor: '#e3e3e3', zeroline: false},
    yaxis: {title: {text: title}, gridcolor: '#e3e3e3', zeroline: false, ...more},
    legend: {orientation: 'h', y: 1.02, yanchor: 'bottom', font: {size: 12}},
    shapes: [{type: 'line', xref: 'x', yref: 'paper', x0: t, x1: t, y0: 0, y1: 1,
      line: {color: '#555555', width: 1.5, dash: 'dot'}}]};
}

function unitOf(strongest) {
  return strongest < 1e-5 ? [1e9, 'nT'] : strongest < 1e-2 ? [1e6, 'µT'] : [1e3, 'mT'];
}

function largest(axes) {
  let max = 0;
  for (const axis of axes) for (const v of axis) if (Math.abs(v) > max) max = Math.abs(v);
  return max;
}

// [{name, t, measured, predictions: [{t, field}]}] of a track, or of the latest frames on a live page
// that follows the time, with the tracks that end in `range` or later.
function fieldsOf(scene, track, range) {
  if (!page.follows) {
    return !track ? [] : track.fields.map(field => ({name: scene.sensors.names[field.sensor],
      t: field.t || track.columns.t, measured: field.measured,
      predictions: [{t: field.t || track.columns.t, field: field.predicted}]}));
  }
  const tracks = scene.tracks.filter(other => endOf(other) > range[0]);
  return scene.sensors.names.map((name, j) => ({name: name, t: scene.recent.t,
    measured: scene.recent.fields.map(axis => axis[j]),
    predictions: tracks.flatMap(other => other.fields.filter(field => field.sensor === j)
      .map(field => ({t: other.columns.t, field: field.predicted})))}));
}

function chosenFields(scene, track, choice, range) {
  const fields = fieldsOf(scene, track, range);
  if (choice !== STRONGEST) return fields.filter(field => field.name === choice);
  const strength = new Map(fields.map(field => {
    const first = indexAt(field.t, range[0]) + 1, end = indexAt(field.t, range[1]) + 1;
    return [field, largest(field.measured.map(axis => axis.slice(first, end)))];
  }));
  const strongest = [...fields].sort((a, b) => strength.get(b) - strength.get(a));
  return fields.filter(field => strongest.slice(0, MAX_PANELS).includes(field));
}

function drawFields(scene, track, choice, t, range) {
  const holder = at('field');
  const fields = chosenFields(scene, track, choice, range);
  at('no-field').hidden = fields.length > 0;
  while (holder.children.length > fields.length) {
    Plotly.purge(holder.lastChild);
    holder.lastChild.remove();
  }
  while (holder.children.length < fields.length) {
    const panel = document.createElement('div');
    panel.className = 'plot panel';
    holder.append(panel);
  }
  holder.style.setProperty('--panels', fields.length);
  const [f, unit] = unitOf(Math.max(0, ...fields.map(field => largest(field.measured))));
  fields.forEach((field, i) => {
    const traces = [], many = field.t.length > DENSE_READINGS;
    // Large dense markers would hide the lines.
    const dots = many ? {size: 3, opacity: 0.45} : {size: 5};
    AXES.forEach(([colour, dash], a) => {
      const name = 'xyz'[a];
      traces.push({type: 'scatter', mode: 'markers', x: field.t, name: `${name} measured`,
        y: scaled(field.measured[a], f), showlegend: false,
        marker: {color: colour, symbol: SYMBOLS[a], ...dots}});
      for (const {t: times, field: predicted} of field.predictions) {
        traces.push(line(times, scaled(predicted[a], f), `${name} predicted`,
          {color: many ? BLACK : colour, width: 1.8, dash: dash},
          {hoverinfo: 'all', showlegend: false}));
      }
    });
    const layout = curveLayout(`${plain(field.name)} [${unit}]`, t, range);
    if (i < fields.length - 1) layout.xaxis.title = {text: ''};
    Plotly.react(holder.children[i], traces, layout, CONFIG);
  });
}

function drawWeights(track, t, range) {
  const traces = Object.entries(stylesOf(page.scene)).filter(([name]) => name in track.arrivals).map(
    ([name, [colour, dash]]) => line(track.columns.t, track.arrivals[name].weight,
      plain(name) || 'all hypotheses', {color: colour, dash: dash, width: 2}, {hoverinfo: 'all'}));
  Plotly.react('weights', traces, curveLayout('weight', t, range, {range: [-0.03, 1.03]}), CONFIG);
}

// Curve of a quantity with its 90 % band.
function drawBand(id, t, range, title, band, low, high, curve) {
  Plotly.react(id, [line(curve.x, low, '', {width: 0}),
    line(curve.x, high, band, {width: 0},
      {fill: 'tonexty', fillcolor: 'rgba(0,114,178,0.18)', hoverinfo: 'skip'}),
    {type: 'scatter', mode: 'lines', line: {color: BLACK, width: 1.5}, ...curve}],
  curveLayout(title, t, range, {rangemode: 'tozero'}), CONFIG);
}

function drawInnovation(track, t, range) {
  const c = track.columns;
  drawBand('innovation', t, range, 'NIS per axis', '90 % band (consistent filter)', c.nis_low,
    c.nis_high, {x: c.t, y: c.nis, name: 'NIS per axis', mode: 'lines+markers', marker: {size: 4}});
}

function drawSpeed(track, t, range) {
  const c = track.columns, speed = Array.from(c.t, (_, k) => Math.hypot(c.vx[k], c.vy[k]));
  const edge = sign => speed.map((v, k) => Math.max(0, v + sign * SCALE_1D * c.speed_sd[k]));
  drawBand('speed', t, range, 'm/s', '90 % band', edge(-1), edge(1),
    {x: c.t, y: speed, name: 'speed'});
}

// Move the time line without redrawing the plots.
function moveLines(t) {
  for (const plot of [...document.querySelectorAll('#field .plot'),
    ...['weights', 'innovation', 'speed'].map(at)]) {
    if (plot.layout) Plotly.relayout(plot, {'shapes[0].x0': t, 'shapes[0].x1': t});
  }
}
