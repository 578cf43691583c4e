// Notes, tables and static charts.
'use strict';

function element(tag, text, more) {
  const e = document.createElement(tag);
  if (text !== undefined && text !== null) e.textContent = text;
  return Object.assign(e, more || {});
}

function table(columns, rows, classes) {
  const out = element('table'), head = element('tr');
  const kind = cell => ({className: typeof cell === 'number' ? 'number' : ''});
  columns.forEach((name, i) => head.append(element('th', name,
    kind(rows.map(row => row[i]).find(cell => typeof cell === 'number')))));
  out.append(element('thead'), element('tbody'));
  out.firstChild.append(head);
  rows.forEach((row, i) => {
    const tr = element('tr', null, {className: classes ? classes[i] : ''});
    for (const cell of row) {
      const td = element('td', null, kind(cell));
      td.append(cell instanceof Node ? cell : shown(cell));
      tr.append(td);
    }
    out.lastChild.append(tr);
  });
  return out;
}

function shown(cell) {
  if (cell === null || cell === undefined) return '–';
  if (typeof cell !== 'number' || Number.isInteger(cell)) return String(cell);
  // Large numbers, such as coordinates, keep two decimals.
  return String(Number(Math.abs(cell) < 1000 ? cell.toPrecision(4) : cell.toFixed(2)));
}

function showNotes(notes) {
  at('notes').replaceChildren(...notes.map(
    note => element('li', note.text, {className: note.level})));
  at('notes').hidden = !notes.length;
}

function card(title) {
  const out = element('div', null, {className: 'card'});
  out.append(element('h2', title));
  return out;
}

function showTables(tables) {
  at('tables').replaceChildren(...tables.map(one => {
    const out = card(one.title), holder = element('div', null, {className: 'table'});
    holder.append(table(one.columns, one.rows));
    out.append(holder);
    return out;
  }));
}

const isEmpty = trace => !(trace.z || trace.y).flat().some(value => value !== null);

// A chart consists of Plotly traces and a layout. Charts without a value are omitted.
function showCharts(all) {
  const holder = at('charts');
  const charts = all.filter(chart => !chart.traces.every(isEmpty));
  for (const chart of charts) {
    const out = card(chart.title), plot = element('div', null, {className: 'plot'});
    out.append(plot);
    holder.append(out);
    out.classList.toggle('wide', chart === charts.at(-1) && charts.length % 2 === 1);
    Plotly.newPlot(plot, chart.traces, {...LAYOUT, margin: {l: 65, r: BUTTONS_PX, t: 10, b: 50},
      legend: {orientation: 'h', y: 1.02, yanchor: 'bottom'},
      ...chart.layout}, CONFIG);
  }
}

function showTrackTable(scene, jump) {
  const columns = ['track', 'start [s]', 'end [s]', 'from', 'kind', 'speed [m/s]',
    'moment [A m²]', 'verdict', 'error [m]', 'doubts (poses)'];
  const rows = scene.tracks.map(track => {
    const facts = track.facts || {};
    const go = element('button', `${facts.label || track.id}`,
      {type: 'button', title: 'Show this track'});
    go.addEventListener('click', () => jump(track));
    return [go, Number(beginOf(track).toFixed(2)), Number(endOf(track).toFixed(2)), facts.arrival, facts.kind, facts.speed,
      facts.moment, facts.verdict || (track.ended ? '' : 'active'), facts.error,
      facts.doubts];
  });
  // Columns without any value are omitted.
  const used = columns.map((_, i) => i === 0 || rows.some(
    row => row[i] !== null && row[i] !== undefined && row[i] !== ''));
  const only = row => row.filter((_, i) => used[i]);
  const found = rows.length ? table(only(columns), rows.map(only)) : element('p', 'No tracks yet.');
  scene.tracks.forEach((track, i) => {
    found.tBodies[0].rows[i].dataset.key = track.key;
  });
  at('tracks').replaceChildren(found);
}

function markTrack(key) {
  for (const row of document.querySelectorAll('#tracks tr.chosen')) row.className = '';
  const row = document.querySelector(`#tracks tr[data-key="${key}"]`);
  if (row) row.className = 'chosen';
}
