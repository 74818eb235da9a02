'use strict';
const DATA = JSON.parse(document.getElementById('data').textContent);
const [WIDE, HIGH] = DATA.size;
const byId = name => document.getElementById(name);
const svgTag = (name, attributes) => {
  const made = document.createElementNS('http://www.w3.org/2000/svg', name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
};
const rows = DATA.rows.map((row, index) => ({...row, index, first: JSON.stringify(row.labels),
  flagged: false, seen: false, empty: false}));
const PREDICTED = rows.some(row => row.found.length);
const changed = row => row.empty || JSON.stringify(row.labels) !== row.first;
const sigmaOf = row => Math.max(0, ...row.labels.map(l => Math.max(l.sigma_u_px, l.sigma_v_px)));
const confidenceOf = row => Math.max(0, ...row.found.map(f => f.confidence));
let shown = [], current = null, chosen = 0;
const UNIT = WIDE / 320; // marks keep their size on large pictures

// Marks: a solid circle for a label, in the colour of its source, a dashed square for a detection.
const drawLabel = (l, kind, k) => svgTag('circle', {class: `label${kind}`, stroke: DATA.colours[l.source] ?? DATA.colours.other,
  cx: l.u_px, cy: l.v_px, r: 14 * UNIT, 'data-label': k});
const drawFound = f => svgTag('rect', {class: `found${f.confidence < DATA.threshold ? ' weak' : ''}`, stroke: DATA.colours.detection,
  x: f.u_px - 10 * UNIT, y: f.v_px - 10 * UNIT, width: 20 * UNIT, height: 20 * UNIT});

// The picture of a row with its labels and detections.
function draw(row, large) {
  const svg = svgTag('svg', {viewBox: `0 0 ${WIDE} ${HIGH}`});
  svg.append(svgTag('image', {width: WIDE, height: HIGH, href: row.image}));
  for (const f of row.found) if (f.confidence >= 0.05) svg.append(drawFound(f));
  row.labels.forEach((l, k) => svg.append(drawLabel(l, large && k === chosen ? ' chosen' : '', k)));
  return svg;
}

function caption(row) {
  const parts = [row.source, row.robot, `${(Number(row.time_ns) / 1e9).toFixed(2)} s`];
  if (PREDICTED) parts.push(`suspicion ${(100 * row.suspicion).toFixed(0)} %`);
  if (row.error_px !== null) parts.push(`error ${row.error_px < 1e6 ? row.error_px.toFixed(1) + ' px' : 'not found'}`);
  const sigma = sigmaOf(row);
  if (sigma > 0) parts.push(`sigma ${sigma.toFixed(1)} px`);
  return parts.join(', ');
}

function refresh(row) {
  const at = byId(`row-${row.index}`);
  if (!at) return;
  at.replaceChildren(draw(row, false), Object.assign(document.createElement('small'), {textContent: caption(row)}));
  at.className = ['row', changed(row) && 'changed', row.flagged && 'flagged', row.seen && 'seen'].filter(Boolean).join(' ');
}

function count() {
  const fixed = rows.filter(changed).length, marked = rows.filter(r => r.flagged).length;
  byId('count').value = `${shown.length} of ${rows.length} images; ${fixed} corrected, ${marked} flagged. `;
}

const ORDERS = {
  suspicion: (a, b) => b.suspicion - a.suspicion,
  error: (a, b) => (b.error_px ?? -1) - (a.error_px ?? -1),
  sigma: (a, b) => sigmaOf(b) - sigmaOf(a),
  time: (a, b) => a.index - b.index,
};

function list() {
  const least = name => Number(byId(name).value || 0);
  const status = byId('status').value, done = byId('done').value;
  shown = rows.filter(row =>
    (!least('error') || (row.error_px ?? -1) >= least('error')) &&
    (!least('sigma') || sigmaOf(row) >= least('sigma')) &&
    (!least('confidence') || confidenceOf(row) >= least('confidence')) &&
    (!status || row.labels.some(l => DATA.statuses[l.status] === status)) &&
    (!done || {changed: changed(row), flagged: row.flagged, open: !row.seen}[done]));
  shown.sort((a, b) => ORDERS[byId('order').value](a, b) || a.index - b.index);
  byId('rows').replaceChildren(...shown.map(row => {
    const cell = document.createElement('button');
    cell.id = `row-${row.index}`;
    cell.addEventListener('click', () => open(row));
    return cell;
  }));
  shown.forEach(refresh);
  count();
}

// The editor.
function open(row) {
  current = row; row.seen = true; chosen = 0;
  if (!byId('editor').open) byId('editor').showModal();
  paint();
}
function paint() {
  byId('stage').replaceChildren(draw(current, true));
  const words = current.labels.map(l => `${l.peer}, ${l.depth_m > 0 ? l.depth_m.toFixed(2) + ' m' : 'no depth'}, ${l.source}`);
  byId('facts').textContent = `${caption(current)}. Labels: ${words.join('; ') || (current.empty ? 'nobody in view' : 'none')}`;
  refresh(current); count();
}
function point(event) {
  const svg = byId('stage').firstChild, at = new DOMPoint(event.clientX, event.clientY);
  const {x, y} = at.matrixTransform(svg.getScreenCTM().inverse());
  return [Math.min(Math.max(x, 0), WIDE), Math.min(Math.max(y, 0), HIGH)];
}
function move(label, u_px, v_px) {
  Object.assign(label, {u_px, v_px, sigma_u_px: 0, sigma_v_px: 0, box_px: [], source: 'hand', status: DATA.ok});
}
function newLabel(u_px, v_px, depth_m) {
  const taken = new Set(current.labels.map(l => l.peer));
  const peer = DATA.peers.find(name => name !== current.robot && !taken.has(name)) ?? `peer-${taken.size + 1}`;
  const known = depth_m > 0;
  const label = {peer, depth_m: known ? depth_m : 0, sigma_depth_m: known ? 0 : Infinity, visible_share: 0};
  move(label, u_px, v_px);
  current.empty = false;
  current.labels.push(label); chosen = current.labels.length - 1;
}
const apart = (a, b) => Math.hypot(a.u_px - b.u_px, a.v_px - b.v_px);

// Put labels that no detection supports on detections that no label explains; draw the others.
function accept() {
  const sure = current.found.filter(f => f.confidence >= DATA.threshold);
  const free = sure.filter(f => current.labels.every(l => apart(l, f) >= DATA.near_px));
  const loose = current.labels.filter(l => sure.every(f => apart(l, f) >= DATA.near_px));
  for (const f of free) {
    loose.sort((a, b) => apart(a, f) - apart(b, f));
    const label = loose.shift();
    if (label) { move(label, f.u_px, f.v_px); Object.assign(label, {depth_m: f.depth_m, sigma_depth_m: 0}); }
    else newLabel(f.u_px, f.v_px, f.depth_m);
  }
}
let dragged = null, drawing = false;
byId('stage').addEventListener('pointerdown', event => {
  const [u, v] = point(event);
  if (drawing) { newLabel(u, v, 0); drawing = false; dragged = current.labels[chosen]; }
  else {
    const place = current.labels.map((l, k) => [apart(l, {u_px: u, v_px: v}), k]).sort((a, b) => a[0] - b[0])[0];
    if (!place || place[0] > 24 * UNIT) return;
    chosen = place[1]; dragged = current.labels[chosen];
  }
  byId('stage').setPointerCapture(event.pointerId);
  paint(); event.preventDefault();
});
byId('stage').addEventListener('pointermove', event => {
  if (dragged) { move(dragged, ...point(event)); paint(); }
});
for (const end of ['pointerup', 'pointercancel']) byId('stage').addEventListener(end, () => { dragged = null; });
const KEYS = {
  ArrowRight: () => step(1), j: () => step(1), ArrowLeft: () => step(-1), k: () => step(-1),
  a: accept,
  n: () => { drawing = true; },
  e: () => { current.labels = []; current.empty = true; },
  x: () => { current.labels.splice(chosen, 1); chosen = 0; },
  f: () => { current.flagged = !current.flagged; },
  z: () => { current.labels = JSON.parse(current.first, (k, v) => v); current.flagged = current.empty = false; revive(current); },
  Tab: () => { chosen = (chosen + 1) % Math.max(current.labels.length, 1); },
};
function step(by) {
  const at = shown.indexOf(current) + by;
  if (shown[at]) open(shown[at]);
}
function press(key) {
  if (key === 'Escape') { byId('editor').close(); return true; }
  if (!current || !byId('editor').open || !KEYS[key]) return false;
  KEYS[key](); paint(); return true;
}
document.addEventListener('keydown', event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (press(event.key)) event.preventDefault();
});
for (const button of document.querySelectorAll('[data-key]'))
  button.addEventListener('click', () => press(button.dataset.key));
byId('help').addEventListener('click', () => alert(
  'Solid circles: labels. Dashed squares: detections. In the editor: drag a label; a accepts the detections; ' +
  'n, then a click, draws a label; e says that nobody is in view; x deletes the chosen one, Tab chooses another; f flags; z undoes; arrows or j, k move.'));

// Corrections as recordings (MCAP), one for each source, with all labels of the corrected images.
const utf8 = new TextEncoder();
const joined = parts => {
  const out = new Uint8Array(parts.reduce((n, part) => n + part.length, 0));
  parts.reduce((at, part) => { out.set(part, at); return at + part.length; }, 0);
  return out;
};
const little = (bytes, write) => { const view = new DataView(new ArrayBuffer(bytes)); write(view); return new Uint8Array(view.buffer); };
const u16 = n => little(2, v => v.setUint16(0, n, true));
const u32 = n => little(4, v => v.setUint32(0, n, true));
const u64 = n => little(8, v => v.setBigUint64(0, BigInt(n), true));
const f64 = n => little(8, v => v.setFloat64(0, n, true));
const text = words => { const bytes = utf8.encode(words); return joined([u32(bytes.length), bytes]); };
const table = pairs => { const body = joined(pairs.flatMap(([k, v]) => [text(k), text(v)])); return joined([u32(body.length), body]); };
const record = (code, ...parts) => { const body = joined(parts); return joined([Uint8Array.of(code), u64(body.length), body]); };
const varint = n => { const out = []; for (; n > 127; n = Math.floor(n / 128)) out.push((n % 128) | 128); out.push(n); return Uint8Array.from(out); };
const field = (number, wire, bytes) => joined([varint(number * 8 + wire), ...(wire === 2 ? [varint(bytes.length)] : []), bytes]);
function encodeLabel(label) {
  const parts = [];
  for (const [name, number, kind] of DATA.fields) {
    const value = label[name];
    if (value === undefined || value === 0 || value === '' || value === false) continue;
    if (kind === 'string') parts.push(field(number, 2, utf8.encode(value)));
    else if (kind === 'double') parts.push(field(number, 1, f64(value)));
    else if (kind === 'doubles') { if (value.length) parts.push(field(number, 2, joined(value.map(f64)))); }
    else parts.push(field(number, 0, varint(Number(value))));
  }
  return joined(parts);
}
function recording(source, corrected) {
  const magic = Uint8Array.of(0x89, 0x4d, 0x43, 0x41, 0x50, 0x30, 0x0d, 0x0a);
  const schema = Uint8Array.from(atob(DATA.schema), c => c.charCodeAt(0));
  const robots = [...new Set(corrected.map(row => row.robot))];
  const parts = [magic, record(1, text(''), text('dmrl desk')),
    record(3, u16(1), text(DATA.schema_name), text('protobuf'), u32(schema.length), schema)];
  robots.forEach((robot, k) => parts.push(record(4, u16(k + 1), u16(1), text(`/${robot}/labels`), text('protobuf'), table([]))));
  corrected.sort((a, b) => (BigInt(a.time_ns) < BigInt(b.time_ns) ? -1 : 1));
  corrected.forEach((row, k) => {
    const peers = row.labels.map(label => field(1, 2, encodeLabel({...label, source: 'hand'})));
    const message = joined([...peers, field(2, 2, utf8.encode('hand'))]);
    parts.push(record(5, u16(robots.indexOf(row.robot) + 1), u32(k), u64(row.time_ns), u64(row.time_ns), message));
  });
  parts.push(record(12, text(DATA.metadata_name), table(Object.entries(DATA.provenance[source]))));
  parts.push(record(15, u32(0)), record(2, u64(0), u64(0), u32(0)), magic);
  return joined(parts);
}
const UNSAVED = {
  save: () => JSON.stringify(rows.filter(changed).map(row => [row.index, row.labels])),
  flags: () => JSON.stringify(rows.filter(row => row.flagged).map(row => row.index)),
};
const saved = {save: UNSAVED.save(), flags: UNSAVED.flags()};
for (const name of ['save', 'flags']) byId(name).addEventListener('click', () => { saved[name] = UNSAVED[name](); });
addEventListener('beforeunload', event => {
  if (Object.keys(saved).some(name => saved[name] !== UNSAVED[name]())) event.preventDefault();
});
function download(name, content, type) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([content], {type}));
  link.download = name; link.click();
}
byId('save').addEventListener('click', () => {
  for (const source of new Set(rows.map(row => row.source))) {
    const mine = rows.filter(row => row.source === source && changed(row));
    if (mine.length) download(`corrections-${source.replace(/\.mcap$/, '')}.mcap`, recording(source, mine), 'application/octet-stream');
  }
});
const cell = value => '"' + String(value).replaceAll('"', '""') + '"';
byId('flags').addEventListener('click', () => {
  const marked = rows.filter(row => row.flagged).map(row => [row.source, row.robot, row.time_ns].map(cell).join(','));
  download('flags.csv', [DATA.flag_columns.join(','), ...marked].join('\n') + '\n', 'text/csv');
});

// JSON has no infinity: a null sigma of the depth stands for it.
function revive(row) { for (const label of row.labels) if (label.sigma_depth_m === null) label.sigma_depth_m = Infinity; }
rows.forEach(row => revive(row));
for (const status of new Set(rows.flatMap(row => row.labels.map(l => DATA.statuses[l.status]))))
  byId('status').append(Object.assign(document.createElement('option'), {textContent: status}));
const LEGEND = [...new Set([...rows.flatMap(row => row.labels.map(l => l.source)), 'hand'])].map(source =>
  [drawLabel({source, u_px: 0, v_px: 0}, ''), `label: ${source}`]);
if (PREDICTED) LEGEND.push([drawFound({u_px: 0, v_px: 0, confidence: 1}), `detection of ${DATA.threshold.toPrecision(2)} or more`],
  [drawFound({u_px: 0, v_px: 0, confidence: 0}), 'less sure']);
for (const [mark, words] of LEGEND) {
  const picture = svgTag('svg', {viewBox: [-18, -18, 36, 36].map(px => px * UNIT).join(' ')});
  picture.append(mark);
  byId('legend').append(picture, ` ${words}\u00a0 `);
}
byId('filters').addEventListener('input', list);
if (!PREDICTED) byId('order').value = 'time';
list();
