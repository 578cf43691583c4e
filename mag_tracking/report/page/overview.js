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
  const scaled = values => Array.from(values, v => f * v);
  if (track.smoothed) return [scaled(track.smoothed.x), scaled(track.smoothed.y)];
  const sure = (_, i) => !track.columns.ambiguous[i];
  return [scaled(track.columns.x.filter(sure)), scaled(track.columns.y.filter(sure))];
}

// One trace per arrival direction; a null ends the path of a track. The current track is wider.
function overviewTraces(scene, current) {
  const f = scene.scale.factor, styles = stylesOf(scene), groups = new Map(), ends = new Map();
  for (const track of scene.tracks) {
    const name = arrivalOf(track), [xs, ys] = pathOf(track, f);
    if (xs.length < 2) continue;
    const [colour] = styles[name] || [BLACK];
    const title = name ? `from ${plain(name)}` : 'tracks';
    const style = {type: 'scatter', name: title, hoverinfo: 'text'};
    if (!groups.has(name)) {
      groups.set(name, {...style, mode: 'lines', x: [], y: [], text: [], customdata: [],
        showlegend: true, line: {color: colour, width: 1.5}});
      ends.set(name, {...style, mode: 'markers', x: [], y: [], text: [], customdata: [],
        showlegend: false, marker: {symbol: 'arrow', size: 9, color: colour, angle: []}});
    }
    const label = `track ${plain((track.facts || {}).label || track.id)}, ` +
      `${beginOf(track).toFixed(1)} s`;
    const group = groups.get(name), end = ends.get(name), n = xs.length;
    group.x.push(...xs, null);
    group.y.push(...ys, null);
    for (const _ of [...xs, null]) {
      group.text.push(label);
      group.customdata.push(track.key);
    }
    const from = Math.max(0, n - 4);
    end.x.push(xs[n - 1]);
    end.y.push(ys[n - 1]);
    end.text.push(label);
    end.customdata.push(track.key);
    end.marker.angle.push(90 - 180 / Math.PI * Math.atan2(ys[n - 1] - ys[from], xs[n - 1] - xs[from]));
  }
  const [xs, ys] = current ? pathOf(current, f) : [[], []];
  return [...roadTraces(scene, f), ...groups.values(), ...ends.values(),
    line(xs, ys, 'current track', {color: BLACK, width: 3.5}, {hoverinfo: 'skip'}),
    sensorTrace(scene, f, 'y')];
}

function drawOverview(scene, current) {
  if (at('overview-card').hidden) return;
  const traces = overviewTraces(scene, current), plot = at('overview');
  Plotly.react(plot, traces, mapLayout(scene, scene.reach.map, ''), CONFIG);
  showLegend('overview-legend', traces);
  plot.removeAllListeners('plotly_click');
  plot.on('plotly_click', event => {
    const key = event.points[0].customdata;
    const track = scene.tracks.find(other => other.key === key);
    if (track) jump(track);
  });
}

const isMagnet = track => Number.isNaN(track.columns.length[0]);

function drawSide(scene, current, t) {
  if (at('side-card').hidden) return;
  const f = scene.scale.factor, traces = [], reach = reachAt(scene, current);
  for (const track of tracksAt(scene, t).filter(isMagnet)) {
    const c = track.columns, k = Math.max(0, indexAt(c.t, t)), named = name => name;
    const [xs, ys] = ellipse(f * c.x[k], f * c.z[k], f * f * c.xx[k], f * f * c.xz[k],
      f * f * c.zz[k]);
    traces.push(...pathTraces(track, k, f, named, 'z'),
      line(xs, ys, '90 % region', {color: BLACK, width: 1},
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
