// Map of all tracks, side view of magnets, and the legends of the maps.
'use strict';

const MIN_TRACKS = 2;

// Name of the heaviest arrival direction at the end of a track.
function arrivalOf(track) {
  const last = track.columns.t.length - 1, names = Object.keys(track.arrivals);
  return names.reduce((best, name) =>
    track.arrivals[name].weight[last] > track.arrivals[best].weight[last] ? name : best, names[0]);
}

// Smoothed path of a track, or its unambiguous poses.
function pathOf(track, f) {
  if (track.smoothed) return [scaled(track.smoothed.x, f), scaled(track.smoothed.y, f)];
  const sure = (_, i) => !track.columns.ambiguous[i];
  return [scaled(track.columns.x.filter(sure), f), scaled(track.columns.y.filter(sure), f)];
}

// One trace per arrival direction; a null ends the path of a track. The current track is wider.
function overviewTraces(scene, current) {
  const f = scene.scale.factor, styles = stylesOf(scene), groups = new Map();
  for (const track of scene.tracks) {
    const name = arrivalOf(track), [xs, ys] = pathOf(track, f), n = xs.length;
    if (n < 2) continue;
    if (!groups.has(name)) groups.set(name, overviewGroup(name, (styles[name] || [BLACK])[0]));
    const [paths, ends] = groups.get(name), from = Math.max(0, n - 4);
    const label = `track ${plain((track.facts || {}).label || track.id)}, ` +
      `${beginOf(track).toFixed(1)} s`;
    const add = (trace, x, y) => {
      for (const [key, value] of Object.entries({x, y, text: label, customdata: track.key})) {
        trace[key].push(value);
      }
    };
    xs.forEach((x, i) => add(paths, x, ys[i]));
    add(paths, null, null);
    add(ends, xs[n - 1], ys[n - 1]);
    ends.marker.angle.push(90 - 180 / Math.PI * Math.atan2(ys[n - 1] - ys[from], xs[n - 1] - xs[from]));
  }
  const [xs, ys] = pathOf(current, f), pairs = [...groups.values()];
  return [...roadTraces(scene, f), ...pairs.map(([paths]) => paths), ...pairs.map(([, ends]) => ends),
    sensorTrace(scene, f, 'y'),
    line(xs, ys, 'current track', {color: BLACK, width: 3.5}, {hoverinfo: 'skip'})];
}

// Empty traces of the paths and of their ends.
function overviewGroup(name, colour) {
  const empty = more => ({type: 'scatter', name: name ? `from ${plain(name)}` : 'tracks',
    hoverinfo: 'text', x: [], y: [], text: [], customdata: [], ...more});
  return [empty({mode: 'lines', showlegend: true, line: {color: colour, width: 1.5}}),
    empty({mode: 'markers', showlegend: false,
      marker: {symbol: 'arrow', size: 9, color: colour, angle: []}})];
}

// Draw all tracks once; later only the current track changes.
function drawOverview(scene, current) {
  const plot = at('overview');
  if (at('overview-card').hidden) return;
  if (plot.scene === scene) {
    const [xs, ys] = pathOf(current, scene.scale.factor);
    Plotly.restyle(plot, {x: [xs], y: [ys]}, [-1]);
    return;
  }
  plot.scene = scene;
  const traces = overviewTraces(scene, current);
  Plotly.newPlot(plot, traces, mapLayout(scene, scene.reach.map, ''), CONFIG);
  showLegend('overview-legend', traces);
  plot.on('plotly_click', event => {
    const track = trackOf(scene, event.points[0].customdata);
    if (track) jump(track);
  });
}

const isMagnet = track => Number.isNaN(track.columns.length[0]);

function drawSide(scene, current, t) {
  if (at('side-card').hidden) return;
  const f = scene.scale.factor, traces = [], reach = reachAt(scene, current);
  for (const track of tracksAt(scene, t).filter(isMagnet)) {
    const c = track.columns, k = Math.max(0, indexAt(c.t, t)), named = name => name;
    traces.push(...pathTraces(track, k, f, named, 'z'),
      regionTrace(c, k, f, 'z', '90 % region', {color: BLACK, width: 1},
        {fill: 'toself', fillcolor: 'rgba(0,0,0,0.12)'}),
      ...bodyTraces(reach.map, c, k, f, named, 'z'));
  }
  traces.push(sensorTrace(scene, f, 'z'));
  Plotly.react('side', traces, mapLayout(scene, reach.side, page.live || current?.key, 'z'), CONFIG);
  showLegend('side-legend', traces);
}

const SVG = 'http://www.w3.org/2000/svg';
const DASH_ARRAYS = {dash: '6 4', dot: '2 3', dashdot: '6 3 2 3', longdash: '10 4'};

// Sample of a trace in a legend.
function sampleOf(trace) {
  const svg = document.createElementNS(SVG, 'svg');
  const shape = (tag, values) => {
    const e = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(values)) e.setAttribute(name, value);
    svg.append(e);
  };
  svg.setAttribute('viewBox', '0 0 26 12');
  if (trace.fill) shape('rect', {x: 1, y: 1, width: 24, height: 10, fill: trace.fillcolor});
  if (trace.mode.includes('lines')) {
    shape('line', {x1: 1, x2: 25, y1: 6, y2: 6, stroke: trace.line.color, 'stroke-width':
      Math.min(trace.line.width, 3), 'stroke-dasharray': DASH_ARRAYS[trace.line.dash] || 'none'});
  } else if (trace.marker.symbol === 'triangle-up') {
    shape('path', {d: 'M13 1 L19 11 L7 11 Z', fill: trace.marker.color});
  } else {
    shape('circle', {cx: 13, cy: 6, r: 4, fill: trace.marker.color, stroke: '#707070'});
  }
  return svg;
}

// Show the names of the traces below a map, where they do not change its size.
function showLegend(id, traces) {
  const named = traces.filter(trace => trace.name && trace.showlegend !== false);
  const first = named.filter((trace, i) => named.findIndex(o => o.name === trace.name) === i);
  at(id).replaceChildren(...first.map(trace => {
    const entry = element('span', unescaped(trace.name));
    entry.prepend(sampleOf(trace));
    return entry;
  }));
}
