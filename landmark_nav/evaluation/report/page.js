'use strict';
const data = JSON.parse(document.getElementById('data').textContent);
const byId = (id) => document.getElementById(id);
const SVG = 'http://www.w3.org/2000/svg';
const CM = 100;  // units of the plan in a metre
const at = ([x, y]) => [CM * x, -CM * y];

/** A new element in `parent`; text is text, whatever it holds. */
function add(parent, tag, attributes = {}, text = null) {
  const inSvg = tag === 'svg' || (parent && parent.namespaceURI === SVG);
  const element = inSvg ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== null) element.textContent = text;
  if (parent) parent.append(element);
  return element;
}

function clear(element) {
  element.replaceChildren();
  return element;
}

/** Path through points; a point that is null ends a piece. */
function path(points) {
  let move = true;
  return points.map((p) => {
    if (!p || p[0] === null || p[1] === null) { move = true; return ''; }
    const step = `${move ? 'M' : 'L'}${p[0].toFixed(2)} ${p[1].toFixed(2)}`;
    move = false;
    return step;
  }).join('');
}

/** Half axes and turn in the plan of three sigma of [xx, xy, yy] in mm^2. */
function ellipse([xx, xy, yy], times) {
  const half = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
  const axis = (value) => 0.3 * times * Math.sqrt(Math.max(value, 0));
  return {rx: axis(half + apart), ry: axis(half - apart),
    turn: -0.5 * Math.atan2(2 * xy, xx - yy) * 180 / Math.PI};
}

/** Around what a plan shows, cm; labels beside the outermost landmarks take so many pixels, on small screens too. */
const MARGIN = 40, LABEL_PX = 28;

/** Zoom by buttons in `bar`, keys, pinch and Ctrl + wheel; pan by dragging. `cover` fills the height. */
function zoomable(svg, bar, whole, cover, changed) {
  let box = null, fitted = true;
  const pointers = new Map();
  const shape = () => svg.clientHeight / Math.max(svg.clientWidth, 1) || 1;
  const widest = () => {
    const byHeight = whole[3] / shape();  // width of a box as high as all of it
    if (cover) return Math.min(byHeight, whole[2]);
    const labelled = (k, pixels) => (whole[k] - 2 * MARGIN) * svg.clientWidth / Math.max(pixels - 2 * LABEL_PX, 1);
    return Math.max(byHeight, whole[2], labelled(2, svg.clientWidth), labelled(3, svg.clientHeight));
  };
  const apply = () => {
    if (!svg.clientWidth) return;  // not laid out: it will be resized
    box[3] = box[2] * shape();
    for (const k of [0, 1]) {
      const center = box[k] + box[k + 2] / 2, inset = Math.min(box[k + 2], whole[k + 2]) / 2;
      const kept = Math.min(Math.max(center, whole[k] + inset), whole[k] + whole[k + 2] - inset);
      box[k] = kept - box[k + 2] / 2;
    }
    svg.setAttribute('viewBox', box.join(' '));
    svg.style.setProperty('--px', box[2] / svg.clientWidth);
    svg.classList.toggle('near', cover ? box[2] < whole[2] : box[2] < 0.99 * widest());
    if (changed) changed(box[2] / svg.clientWidth);
  };
  const around = (x, y, width) => {
    fitted = false;
    box = [x - width / 2, y - width * shape() / 2, width, 0];
    apply();
  };
  const fit = () => {
    around(whole[0] + whole[2] / 2, whole[1] + whole[3] / 2, widest());
    fitted = true;
  };
  const zoom = (factor, x = box[0] + box[2] / 2, y = box[1] + box[3] / 2) => {
    const width = Math.min(Math.max(box[2] * factor, whole[2] / 60), Math.max(widest(), whole[2]));
    const by = width / box[2];
    fitted = false;
    box = [x - by * (x - box[0]), y - by * (y - box[1]), width, 0];
    apply();
  };
  const place = (event) => {
    const frame = svg.getBoundingClientRect();
    return [box[0] + (event.clientX - frame.left) * box[2] / frame.width,
      box[1] + (event.clientY - frame.top) * box[3] / frame.height];
  };
  const buttons = add(bar, 'span', {class: 'zoom'});
  for (const [sign, name, act] of [['+', 'zoom in', () => zoom(0.6)], ['−', 'zoom out', () => zoom(1 / 0.6)],
    ['⤢', 'show all', fit]]) {
    add(buttons, 'button', {type: 'button', 'aria-label': name, title: name}, sign).addEventListener('click', act);
  }
  svg.addEventListener('wheel', (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(0.004 * event.deltaY), ...place(event));
  }, {passive: false});
  svg.addEventListener('pointerdown', (event) => pointers.set(event.pointerId, [event.clientX, event.clientY]));
  svg.addEventListener('pointermove', (event) => {
    const last = pointers.get(event.pointerId);
    if (!last || !svg.classList.contains('near') && pointers.size < 2) return;
    const next = [event.clientX, event.clientY];
    if (!svg.hasPointerCapture(event.pointerId)) {
      if (Math.hypot(next[0] - last[0], next[1] - last[1]) < 4) return;
      svg.setPointerCapture(event.pointerId);  // from here on it is no click
    }
    if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
      const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(apart(last) / Math.max(apart(next), 1), ...place(event));
    } else {
      const scale = box[2] / svg.clientWidth;
      box = [box[0] - scale * (next[0] - last[0]), box[1] - scale * (next[1] - last[1]), box[2], 0];
      apply();
    }
    pointers.set(event.pointerId, next);
  });
  for (const end of ['pointerup', 'pointercancel']) {
    svg.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  svg.addEventListener('keydown', (event) => {
    const factor = {'+': 0.6, '-': 1 / 0.6}[event.key];
    if (factor) zoom(factor);
    else if (event.key === '0') fit();
  });
  new ResizeObserver(() => (fitted ? fit() : apply())).observe(svg);
  return {around};
}

/** Show of the labels [element, x, y, length] those that lie on no other, and on none of the dots [x, y]. */
function thin(labels, px, dots = []) {
  const placed = dots.map(([x, y]) => [x, y, 8 * px, 8 * px]);
  for (const {element, x, y, length} of labels) {
    const width = px * (7 * length + 4), height = 12 * px;
    const free = placed.every(([u, v, w, h]) => Math.abs(u - x) > (w + width) / 2 || Math.abs(v - y) > (h + height) / 2);
    element.style.display = free ? '' : 'none';
    if (free) placed.push([x, y, width, height]);
  }
}

const landmarks = new Map((data.map ? data.map.landmarks : []).map((k) => [k.id, k]));
const run = data.run;
let magnify = 10;
let picked = null;
let now = 0;
const redraw = [];  // what depends on the moment

/** Mark a landmark everywhere, and say what it is. */
function pick(id) {
  picked = id;
  mark();
  const box = byId('picked'), landmark = landmarks.get(id);
  if (!box || !landmark) return;
  clear(box);
  if (landmark.patch) add(box, 'img', {src: `data:image/jpeg;base64,${landmark.patch}`, alt: `patch of landmark ${id}`});
  add(box, 'strong', {}, `Landmark ${id}`);
  const list = add(box, 'dl');
  const rows = [
    ['wall', landmark.wall || '-'], ['at', `${landmark.at.map((v) => v.toFixed(3)).join(', ')} m`],
    ['sigma', `${landmark.sigma_mm.map((v) => v.toFixed(1)).join(', ')} mm`],
    ['size', `${landmark.size.map((v) => (100 * v).toFixed(0)).join(' × ')} cm`],
    ['threshold', `NCC ${landmark.threshold}`],
  ];
  if (landmark.expected !== null) rows.push(['found', `in ${landmark.found} of ${landmark.expected} images that looked for it`]);
  for (const [name, value] of rows) { add(list, 'dt', {}, name); add(list, 'dd', {}, value); }
}

function mark() {
  for (const element of document.querySelectorAll('[data-id]')) {
    element.classList.toggle('picked', picked !== null && element.dataset.id === String(picked));
  }
}

/** Robot: an arrow of 30 cm along its heading. */
const ARROW = 'M18 0L-12 11L-7 0L-12 -11Z';
const placed = (pose) => {
  const [x, y] = at(pose);
  return `translate(${x} ${y}) rotate(${-pose[2] * 180 / Math.PI})`;
};

function drawPlan() {
  const {walls, papers, sweeps} = data.map;
  const points = [...walls.flatMap((w) => w.ends), ...[...landmarks.values()].map((k) => k.at),
    ...sweeps.map((s) => s.pose), ...(run ? run.pose : [])].map(at);
  const low = [0, 1].map((k) => Math.min(...points.map((p) => p[k])) - MARGIN);
  const size = [0, 1].map((k) => Math.max(...points.map((p) => p[k])) + MARGIN - low[k]);
  const svg = add(byId('plan'), 'svg', {class: 'plan', tabindex: 0, role: 'group',
    'aria-label': 'plan: arrow keys go from landmark to landmark, + and - zoom'});
  svg.style.aspectRatio = `${size[0]} / ${size[1]}`;
  const wedge = run ? add(svg, 'path', {class: 'view'}) : null;
  for (const wall of walls) {
    add(add(svg, 'path', {class: 'wall', d: path(wall.ends.map(at))}), 'title', {}, wall.id);
  }
  for (const paper of papers) {
    const [x, y] = at(paper.at);
    add(svg, 'rect', {x: x - 6, y: y - 6, width: 12, height: 12, fill: `rgb(${paper.rgb})`});
  }
  for (const [name, line] of Object.entries(run ? run.lines : {})) {
    add(svg, 'path', {class: `line ${name}`, d: path(line.map(at))});
  }
  for (const {pose} of sweeps) {
    add(svg, 'path', {class: 'sweep', d: 'M14 0L-9 9L-9 -9Z', transform: placed(pose)});
  }
  const labels = [], ellipses = [];
  for (const [id, {at: position, normal, size: [width]}] of landmarks) {
    const group = add(svg, 'g', {class: 'landmark', 'data-id': id});
    const [x, y] = at(position), [nx, ny] = [normal[0], -normal[1]];
    const half = CM * width / 2;
    ellipses.push([add(group, 'ellipse', {transform: `translate(${x} ${y})`}), landmarks.get(id).ellipse, x, y]);
    add(group, 'path', {class: 'patch', d: path([[x - half * ny, y + half * nx], [x + half * ny, y - half * nx]])});
    add(group, 'circle', {cx: x, cy: y});
    add(group, 'circle', {class: 'touch', cx: x, cy: y});
    labels.push({element: add(group, 'text', {class: 'label'}, id), x0: x, y0: y, nx, ny, length: String(id).length});
  }
  const label = (px) => {
    for (const one of labels) {
      const away = px * (8 + 3.5 * one.length * Math.abs(one.nx) + 6 * Math.abs(one.ny));
      one.x = one.x0 - away * one.nx; one.y = one.y0 - away * one.ny;
      one.element.setAttribute('x', one.x); one.element.setAttribute('y', one.y);
    }
    thin(labels, px, labels.map(({x0, y0}) => [x0, y0]));
  };
  zoomable(svg, byId('plan').firstElementChild, [...low, ...size], false, label);
  const grow = () => {
    for (const [element, covariance, x, y] of ellipses) {
      const {rx, ry, turn} = ellipse(covariance, magnify);
      element.setAttribute('rx', rx); element.setAttribute('ry', ry);
      element.setAttribute('transform', `translate(${x} ${y}) rotate(${turn})`);
    }
  };
  byId('magnify').addEventListener('change', (event) => { magnify = Number(event.target.value); grow(); if (run) show(now); });
  grow();
  legend(byId('plan'), [
    ...(run ? [['fused', 'line fused'], ['odometry alone', 'line odometry'],
      ...(run.lines.truth.length ? [['truth', 'line truth']] : []),
      ...(run.lines.smoothed ? [['smoothed', 'line smoothed']] : []),
      ['3 sigma', 'sigma'], ['protection level', 'level'], ['used', 'ray'], ['found, not used', 'ray refused'],
      ['not found', 'ray missed'], ['field of view', 'view']] : []),
    ...(landmarks.size ? [['landmark', 'landmark']] : []),
    ...(sweeps.length ? [['sweep', 'sweep']] : []),
  ]);
  svg.addEventListener('keydown', (event) => {
    const step = {ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1}[event.key];
    if (!step || !landmarks.size) return;
    event.preventDefault();
    event.stopPropagation();
    const ids = [...landmarks.keys()];
    pick(ids[(Math.max(ids.indexOf(picked), step < 0 ? 0 : -1) + step + ids.length) % ids.length]);
  });
  if (!run) return;
  const rays = add(svg, 'g');
  const level = add(svg, 'circle', {class: 'level'}), sigma = add(svg, 'ellipse', {class: 'sigma'});
  const truth = add(svg, 'g', {class: 'true-robot'}), robot = add(svg, 'g', {class: 'robot', id: 'robot'});
  add(truth, 'path', {d: ARROW});
  add(robot, 'path', {d: ARROW});
  const reach = 0.35 * Math.max(...size) / CM;
  redraw.push((k) => {
    const pose = run.pose[k], [x, y] = at(pose), turn = (x0, y0) => [
      pose[0] + x0 * Math.cos(pose[2]) - y0 * Math.sin(pose[2]), pose[1] + x0 * Math.sin(pose[2]) + y0 * Math.cos(pose[2])];
    robot.setAttribute('transform', placed(pose));
    truth.style.display = run.truth[k][0] === null ? 'none' : '';
    if (run.truth[k][0] !== null) truth.setAttribute('transform', placed(run.truth[k]));
    const {rx, ry, turn: angle} = ellipse(run.ellipse[k], magnify);
    for (const [name, value] of Object.entries({rx, ry, transform: `translate(${x} ${y}) rotate(${angle})`})) {
      sigma.setAttribute(name, value);
    }
    const radius = run.level[k][0] === null ? 0 : CM * magnify * run.level[k][0];
    for (const [name, value] of Object.entries({cx: x, cy: y, r: radius})) level.setAttribute(name, value);
    const axis = turn(...run.axis), camera = run.camera[k];
    const along = (bearing, length) => [axis[0] + length * Math.cos(pose[2] + bearing), axis[1] + length * Math.sin(pose[2] + bearing)];
    wedge.setAttribute('d', camera === null ? '' : `${path([axis, along(camera - run.half_view, reach), along(camera, reach * 1.08), along(camera + run.half_view, reach)].map(at))}Z`);
    clear(rays);
    for (const one of run.seen[k]) {
      const landmark = landmarks.get(one.id);
      if (!landmark) continue;
      const end = one.bearing === undefined ? landmark.at
        : along(one.bearing, Math.hypot(landmark.at[0] - axis[0], landmark.at[1] - axis[1]));
      add(rays, 'path', {class: `ray ${kind(one)}`, d: path([axis, end].map(at))});
    }
  });
}

const kind = (one) => (one.used ? 'used' : one.bearing === undefined ? 'missed' : 'refused');

/** Names with a sample of each line. */
function legend(parent, entries) {
  const list = add(parent, 'ul', {class: 'legend'});
  for (const [name, style] of entries) {
    const item = add(list, 'li');
    const sample = add(item, 'svg', {viewBox: '0 0 26 10', 'aria-hidden': 'true', class: 'sample chart'});
    if (/sigma|band|view/.test(style)) add(sample, 'rect', {class: style, width: 26, height: 10});
    else if (style === 'landmark') {
      const group = add(sample, 'g', {class: style});
      add(group, 'path', {class: 'patch', d: 'M5 5H21'});
      add(group, 'ellipse', {cx: 13, cy: 5, rx: 12, ry: 4});
    } else add(sample, 'path', {class: style, d: /dots/.test(style) ? 'M13 5h0' : /sweep/.test(style) ? 'M20 5L8 1L8 9Z' : 'M0 5H26'});
    item.append(name);
  }
}

function drawView() {
  if (!byId('view')) return;
  const frame = add(byId('view'), 'div'), [width, height] = run.image_size;
  frame.style.aspectRatio = `${width} / ${height}`;
  const image = add(frame, 'img', {id: 'camera', alt: 'camera image'});
  const over = add(frame, 'svg', {class: 'over', viewBox: `0 0 ${width} ${height}`});
  let shown = null;
  new ResizeObserver(() => over.style.setProperty('--px', width / over.clientWidth)).observe(over);
  redraw.push((k) => {
    const number = run.image[k];
    if (number === shown) return;
    shown = number;
    clear(over);
    image.style.visibility = number < 0 ? 'hidden' : '';
    if (number < 0) return;
    image.src = `data:image/jpeg;base64,${data.images[number]}`;
    const moment = run.image_moment[number], labels = [];
    byId('view-time').textContent = `camera image at ${run.t[moment].toFixed(2)} s`;
    for (const one of run.seen[moment]) {
      const style = {class: kind(one), 'data-id': one.id};
      const corner = one.outline ? one.outline[0] : one.uv;
      if (one.outline) add(over, 'polygon', {...style, points: one.outline.join(' ')});
      if (one.uv) add(over, 'circle', {...style, cx: one.uv[0], cy: one.uv[1], r: width / 160});
      if (!corner) continue;
      labels.push({element: add(over, 'text', {x: corner[0], y: corner[1] - 0.02 * height}, one.id),
        x: corner[0], y: corner[1], length: String(one.id).length});
    }
    thin(labels, width / Math.max(over.clientWidth, 1));
    const table = add(clear(byId('seen')), 'table'), head = add(add(table, 'thead'), 'tr');
    for (const name of ['landmark', 'score', 'what became of it']) add(head, 'th', {scope: 'col'}, name);
    const body = add(table, 'tbody');
    for (const one of run.seen[moment]) {
      const row = add(body, 'tr', {'data-id': one.id});
      const what = {used: 'used', refused: 'not used', missed: 'not found'}[kind(one)];
      add(row, 'td', {}, one.id);
      add(row, 'td', {}, one.score === undefined || one.score === null ? '' : one.score.toFixed(2));
      add(row, 'td', {}, one.reason && one.reason !== what ? `${what}: ${one.reason}` : what);
    }
    mark();
  });
}

/** Steps of 1, 2 or 5 that make some `count` ticks. */
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k += 1) found.push(Number((k * step).toPrecision(6)));
  return found;
}

const LEFT = 46, RIGHT = 8, TALL = 120;

function drawCharts() {
  const parent = byId('charts');
  if (!parent || !data.charts.length) return;
  const all = data.charts.flatMap((c) => [...c.t, ...c.series.flatMap((s) => s.t || [])]);
  const first = all.reduce((a, b) => Math.min(a, b), Infinity);
  const last = all.reduce((a, b) => Math.max(a, b), -Infinity);
  const charts = [...data.charts];
  if (run) {
    const found = run.seen.map((list) => list.filter((one) => one.bearing !== undefined).length);
    const used = run.seen.map((list) => list.filter((one) => one.used).length);
    charts.push({label: 'landmarks', low: 0, limit: 1 + found.reduce((a, b) => Math.max(a, b), 1), t: run.t, series: [
      {name: 'landmarks found', kind: 'line', color: 'odometry', y: found}, {name: 'landmarks used', kind: 'line', color: 'used', y: used}]});
  }
  const names = new Map();
  for (const {series} of charts) for (const s of series) names.set(`${s.name}${s.color}`, [s.name, `${s.kind} ${s.color}`]);
  legend(parent, [...names.values()]);
  const drawn = add(parent, 'div'), cursors = [];
  const draw = () => {
    clear(drawn);
    cursors.length = 0;
    const width = Math.max(drawn.clientWidth, 200), wide = width - LEFT - RIGHT;
    const x = (t) => wide * (t - first) / Math.max(last - first, 1e-9);
    const panel = (tall, name) => {
      const svg = add(drawn, 'svg', {class: 'chart', viewBox: `0 0 ${width} ${tall + 14}`, role: 'img', 'aria-label': name});
      svg.style.height = `${tall + 14}px`;
      const inner = add(svg, 'svg', {x: LEFT, y: 4, width: wide, height: tall});
      return [svg, inner];
    };
    for (const {label, low, limit, t, series} of charts) {
      const title = add(drawn, 'p', {class: 'of-chart'}, label);
      const [svg, inner] = panel(TALL, label), bottom = low === undefined ? -limit : low;
      const y = (v) => (v === null ? null : TALL * (limit - v) / (limit - bottom));
      for (const v of ticks(bottom, limit, 4)) {
        add(inner, 'path', {class: 'axis', d: `M0 ${y(v)}H${wide}`});
        add(svg, 'text', {x: LEFT - 5, y: y(v) + 8, 'text-anchor': 'end'}, v);
      }
      let beyond = 0;
      for (const s of series) {
        const times = s.t || t, points = s.y.map((v, k) => (v === null ? null : [x(times[k]), y(v)]));
        const style = {class: `${s.kind} ${s.color}`};
        const mirrored = () => s.y.map((v, k) => (v === null ? null : [x(times[k]), y(-v)]));
        if (s.kind === 'band') {
          const known = points.map((p, k) => [p, s.y[k]]).filter(([p]) => p);
          const back = known.map(([p, v]) => [p[0], y(-v)]).reverse();
          add(inner, 'path', {...style, d: `${path([...known.map(([p]) => p), ...back])}Z`});
        } else if (s.kind === 'dots') {
          beyond += s.y.filter((v) => v !== null && Math.abs(v) > limit).length;
          add(inner, 'path', {...style, d: points.filter(Boolean).map((p) => `M${p[0].toFixed(1)} ${p[1].toFixed(1)}h0`).join('')});
        } else {
          add(inner, 'path', {...style, d: path(points)});
          if (s.kind === 'level') add(inner, 'path', {...style, d: path(mirrored())});
        }
      }
      if (beyond) title.textContent += `; ${beyond} beyond the axis`;
      cursors.push(add(inner, 'path', {class: 'cursor', visibility: run ? '' : 'hidden'}));
    }
    if (run) {
      const [svg, inner] = panel(46, 'state and reasons'), why = [];
      add(svg, 'text', {x: 2, y: 46}, 'state');
      for (let k = 0, end; k < run.t.length; k = end) {
        for (end = k + 1; end < run.t.length && run.status[end] === run.status[k]; end += 1);
        const until = end < run.t.length ? run.t[end] : last, name = run.status[k];
        const tall = {OK: 8, degraded: 18}[name] || 30;
        const bar = add(inner, 'rect', {class: `status-${name.replace(/\W/g, '')}`, x: x(run.t[k]), y: 46 - tall,
          width: Math.max(x(until) - x(run.t[k]), 1.5), height: tall});
        const reason = run.reasons[run.reason[k]];
        add(bar, 'title', {}, `${name} from ${run.t[k]} s: ${reason}`);
        if (name !== 'OK') {
          const start = Math.max(Math.min(x(run.t[k]), wide - 6 * reason.length), 0);
          const element = add(inner, 'text', {x: start, y: 11}, reason);
          why.push({element, x: start + 3 * reason.length, y: 0, length: 6 * reason.length / 7});
        }
      }
      thin(why, 1);
      cursors.push(add(inner, 'path', {class: 'cursor'}));
      add(drawn, 'p', {class: 'hint'}, 'State: a low bar is OK, a middle one degraded, a high one lost.');
    }
    const [axis] = panel(14, 'time');
    for (const t of ticks(first, Math.max(last, first + 1e-6), Math.max(wide / 60, 2))) {
      add(axis, 'text', {x: LEFT + x(t), y: 12, 'text-anchor': 'middle'}, `${t} s`);
    }
    drawn.insertBefore(axis, drawn.querySelector('p.hint'));
    if (run) place(now);
  };
  const place = (k) => {
    const mid = ((drawn.clientWidth - LEFT - RIGHT) * (run.t[k] - first) / Math.max(last - first, 1e-9)).toFixed(1);
    for (const cursor of cursors) cursor.setAttribute('d', `M${mid} 0V${TALL}`);
  };
  if (run) {
    redraw.push(place);
    const point = (event) => {
      if (event.type === 'pointermove' && !event.buttons) return;
      if (!event.target.closest('.chart')) return;
      const frame = drawn.getBoundingClientRect();
      seek(first + (last - first) * (event.clientX - frame.left - LEFT) / (frame.width - LEFT - RIGHT));
    };
    drawn.addEventListener('pointerdown', point);
    drawn.addEventListener('pointermove', point);
  }
  new ResizeObserver(draw).observe(drawn);
  draw();
}

function drawPanoramas() {
  for (const parent of document.querySelectorAll('.panorama')) {
    const {image, size: [width, height], candidates} = data.panoramas[parent.dataset.panorama];
    const bar = add(parent, 'div', {class: 'bar'});
    const says = add(bar, 'span', {'aria-live': 'polite'}, candidates.length
      ? 'Green and bold: elected, with number. Click one.' : 'Thin: candidates. Green and bold: landmarks, with number.');
    const svg = add(parent, 'svg', {class: 'over', tabindex: 0, role: 'group',
      'aria-label': 'panorama: arrow keys go from candidate to candidate, + and - zoom'});
    svg.style.setProperty('--tall', `${100 * height / width}cqw`);
    add(svg, 'image', {href: `data:image/jpeg;base64,${image}`, width, height, preserveAspectRatio: 'none'});
    const labels = [];
    candidates.forEach(({at: [x, y, w, h], id}, number) => {
      for (const column of [x - width, x, x + width]) {  // what lies across the seam is at both ends
        if (column < -w || column > width + w) continue;
        const style = id === null ? {} : {class: 'elected', 'data-id': id};
        add(svg, 'rect', {...style, x: column - w / 2, y: y - h / 2, width: w, height: h, 'data-candidate': number});
        if (id !== null) {
          const element = add(svg, 'text', {x: column, y: y - h / 2}, id);
          labels.push({element, x: column, y: y - h / 2, length: String(id).length});
        }
      }
    });
    const view = zoomable(svg, bar, [0, 0, width, height], true, (px) => thin(labels, px));
    let chosen = -1;
    const choose = (number) => {
      chosen = number;
      const {id, reason, saliency} = candidates[number];
      says.textContent = `Candidate ${number + 1} of ${candidates.length}, saliency ${saliency}: ${id === null ? `refused: ${reason}` : `elected as landmark ${id}`}`;
      for (const rect of svg.querySelectorAll('rect')) rect.classList.toggle('picked', rect.dataset.candidate === String(number));
      if (id !== null) pick(id);
    };
    svg.addEventListener('click', (event) => {
      const rect = event.target.closest('[data-candidate]');
      if (rect) choose(Number(rect.dataset.candidate));
    });
    svg.addEventListener('keydown', (event) => {
      const step = {ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1}[event.key];
      if (!step || !candidates.length) return;
      event.preventDefault();
      event.stopPropagation();
      choose((Math.max(chosen, step < 0 ? 0 : -1) + step + candidates.length) % candidates.length);
      const [x, y] = candidates[chosen].at;
      view.around(x, y, Math.min(width, 3 * svg.clientWidth));
    });
  }
}

/** Go to a moment. */
function show(k) {
  now = Math.min(Math.max(k, 0), run.t.length - 1);
  const t = run.t[now], end = run.t[run.t.length - 1];
  const slider = byId('time');
  slider.value = now;
  slider.setAttribute('aria-valuetext', `${t.toFixed(2)} seconds`);
  byId('clock').textContent = `${t.toFixed(2)} of ${end.toFixed(2)} s`;
  const seen = run.seen[now], [x, y, heading] = run.pose[now];
  const sigma = ellipse(run.ellipse[now], 1).rx, [level, turn] = run.level[now], truth = run.truth[now];
  const degrees = 180 / Math.PI, wrap = (a) => Math.atan2(Math.sin(a), Math.cos(a));
  byId('state').textContent = [
    `${run.status[now]}${run.reasons[run.reason[now]] ? `: ${run.reasons[run.reason[now]]}` : ''}`,
    `(${x.toFixed(2)}, ${y.toFixed(2)}) m, ${(degrees * heading).toFixed(1)}°`,
    ...(truth[0] === null ? [] : [`error ${(100 * Math.hypot(x - truth[0], y - truth[1])).toFixed(1)} cm, ${Math.abs(degrees * wrap(heading - truth[2])).toFixed(2)}°`]),
    `3 sigma ${sigma.toFixed(1)} cm, ${(3 * degrees * run.heading_sigma[now]).toFixed(2)}°`,
    ...(level === null ? [] : [`protection level ${(100 * level).toFixed(1)} cm, ${(degrees * turn).toFixed(2)}°`]),
    `landmarks used: ${seen.filter((one) => one.used).length}, not used: ${seen.filter((one) => !one.used).length}`,
  ].join(' · ');
  for (const draw of redraw) draw(now);
}

/** Go to the moment next to a time. */
function seek(t) {
  let low = 0, high = run.t.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (run.t[middle] <= t) low = middle; else high = middle;
  }
  show(t - run.t[low] > run.t[high] - t ? high : low);
}

function player() {
  const slider = byId('time'), button = byId('play');
  slider.max = run.t.length - 1;
  let playing = false, clock = 0, before = 0;
  const frame = (time) => {
    if (!playing) return;
    clock += (time - before) / 1000 * Number(byId('speed').value);
    before = time;
    let k = now;
    while (k < run.t.length - 1 && run.t[k + 1] <= clock) k += 1;
    if (k !== now) show(k);
    if (k === run.t.length - 1) toggle(); else requestAnimationFrame(frame);
  };
  const toggle = () => {
    playing = !playing;
    button.textContent = playing ? '❚❚ pause' : '▶ play';
    button.setAttribute('aria-pressed', playing);
    if (!playing) return;
    if (now === run.t.length - 1) show(0);
    clock = run.t[now];
    before = performance.now();
    requestAnimationFrame(frame);
  };
  const jump = (move) => { move(); clock = run.t[now]; };
  button.addEventListener('click', toggle);
  slider.addEventListener('input', () => jump(() => show(Number(slider.value))));
  document.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest('button, select, summary, input:not(#time)')) return;
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key];
    if (step) jump(() => (event.shiftKey ? seek(run.t[now] + step) : show(now + step)));
    else if (event.key === 'Home') jump(() => show(0));
    else if (event.key === 'End') jump(() => show(run.t.length - 1));
    else if (event.key === ' ') toggle();
    else return;
    event.preventDefault();
  });
  document.addEventListener('click', (event) => {
    const row = event.target.closest('[data-time]');
    if (row) { jump(() => seek(Number(row.dataset.time))); byId('player').scrollIntoView(); }
  });
  const linked = () => {
    const time = /^#t=([\d.]+)$/.exec(location.hash);  // a link to a moment
    if (time) jump(() => seek(Number(time[1])));
  };
  window.addEventListener('hashchange', linked);
  show(0);
  linked();
}

document.addEventListener('click', (event) => {
  const element = event.target.closest('[data-id]');
  if (element) pick(Number(element.dataset.id));
});
window.addEventListener('beforeprint', () => { for (const one of document.querySelectorAll('details')) one.open = true; });
if (data.map) drawPlan();
if (run) drawView();
drawCharts();
if (data.panoramas) drawPanoramas();
if (run) player();
