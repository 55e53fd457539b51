// The page's numbers, its colours and its map; page_charts.js follows in the same scope.
const $ = id => document.getElementById(id);
const D = JSON.parse($("data").textContent), N = D.n, SETS = D.sigmas;
const MARKS = ["●", "▲", "◆", "✕"], AXES = ["roll", "pitch", "yaw", "x, forward", "y, left", "z, up"];
const dark = matchMedia("(prefers-color-scheme: dark)"), TAU = 2 * Math.PI;
const style = name => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
const words = name => name.replace("_", " ");
const rgb = hex => [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16));
const mix = (a, b, t) => a.map((v, i) => Math.round(v + (b[i] - v) * t));
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);
const finite = values => values.filter(v => v !== null);
const quantile = (values, q) => {
  const s = finite(values).sort((a, b) => a - b);
  return s.length ? s[Math.round(q * (s.length - 1))] : 0;
};
const short = v => v === null ? "–" : v === 0 ? "0" : Math.abs(v) >= 100 ? v.toFixed(0) : String(+v.toPrecision(3));
const brief = v => v === null ? "–" : String(+v.toPrecision(2));
const metres = (v, round = short) => v === null ? "–" : Math.abs(v) < 1 ? round(100 * v) + " cm" : round(v) + " m";
const apart = (a, b) => a[0].map((_, i) => Math.hypot(a[0][i] - b[0][i], a[1][i] - b[1][i], a[2][i] - b[2][i]));
const size = set => set.sigma[3].map((_, i) => set.sigma[3][i] === null ? null : Math.hypot(...[3, 4, 5].map(k => set.sigma[k][i])));
const stages = Object.keys(D.timing);
const total = D.t.map((_, i) => stages.reduce((sum, name) => sum + (D.timing[name][i] || 0), 0));
const certain = SETS[0].sigma[0].some(v => v !== null), sure = D.confidence.some(v => v !== null);
const missed = D.truth && apart(D.track, D.truth), missedRefined = D.truth && D.refined && apart(D.refined, D.truth);

// ---- colours -------------------------------------------------------------------------------------------------------------------------
const VIRIDIS = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"].map(rgb);
const ramp = t => {  // without the end that the background swallows
  const s = 5 * (dark.matches ? .22 + .78 * t : .86 * t), i = Math.min(Math.floor(s), 4);
  return `rgb(${mix(VIRIDIS[i], VIRIDIS[i + 1], s - i)})`;
};
const MODES = [
  {name: "status"},
  sure && {name: "confidence", values: D.confidence, unit: ""},
  certain && {name: "sigma of the position", values: size(SETS[0]), unit: "cm", scale: 100},
  certain && {name: "sigma of the motion", values: size(SETS[SETS.length - 1]), unit: "cm", scale: 100},
  missed && {name: "error of the position", values: missed, unit: "cm", scale: 100},
  missedRefined && {name: "error of the refined position", values: missedRefined, unit: "cm", scale: 100},
  {name: "speed", values: D.speed, unit: "m/s"},
  {name: "time per scan", values: total, unit: "ms"},
].filter(Boolean);
for (const mode of MODES.slice(1)) {
  mode.low = quantile(mode.values, .02); mode.high = quantile(mode.values, .98);
  mode.level = mode.values.map(v => v === null ? null : Math.round(20 * clamp((v - mode.low) / (mode.high - mode.low || 1), 0, 1)) / 20);
}
let mode = MODES[0], theme = {};
const colourOf = i => !mode.values ? theme.status[D.status[i]] : mode.level[i] === null ? theme.soft : ramp(mode.level[i]);

// ---- map -----------------------------------------------------------------------------------------------------------------------------
const canvas = $("canvas"), g = canvas.getContext("2d"), C = D.cloud;
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const stored = new Int16Array(bytes(C.points).buffer), levels = bytes(C.levels), cloud = new Float32Array(3 * C.count);
for (let i = 0; i < cloud.length; i++) cloud[i] = C.middle[i % 3] + C.step[i % 3] * stored[i];
let W = 1, H = 1, dpr = 1, view = null, shown = 0, current = 0, waiting = false;
const at = (track, i) => [track[0][i], track[1][i], track[2][i]];
const project = ([x, y, z]) => {
  const {c, scale, yaw, tilt} = view, dx = x - c[0], dy = y - c[1], cos = Math.cos(yaw), sin = Math.sin(yaw);
  return [W / 2 + scale * (cos * dx - sin * dy), H / 2 - scale * ((sin * dx + cos * dy) * Math.cos(tilt) + (z - c[2]) * Math.sin(tilt))];
};
const ground = (dx, dy) => {  // a step on the screen as one on the plane
  const u = dx / view.scale, v = -dy / view.scale / Math.max(Math.cos(view.tilt), .2), cos = Math.cos(view.yaw), sin = Math.sin(view.yaw);
  return [cos * u + sin * v, cos * v - sin * u];
};
function fit() {
  const tracks = [D.track, D.truth, D.refined].filter(Boolean), ends = k => tracks.flatMap(t => [quantile(t[k], 0), quantile(t[k], 1)]);
  const low = [0, 1, 2].map(k => Math.min(...ends(k))), high = [0, 1, 2].map(k => Math.max(...ends(k)));
  const [w, h] = [0, 1].map(k => Math.max(high[k] - low[k], 10) + 16), room = [W - 90, H - 90].map(v => Math.max(v, 60));
  const across = Math.min(room[0] / w, room[1] / h), upright = Math.min(room[0] / h, room[1] / w);
  const yaw = upright > 1.15 * across ? Math.PI / 2 : 0;  // a long drive stands upright on a phone
  view = {c: low.map((v, k) => (v + high[k]) / 2), scale: Math.max(across, upright), yaw, tilt: 0};
  $("tilt").setAttribute("aria-pressed", false);
  paint();
}
function drawCloud() {
  const w = canvas.width, h = canvas.height, image = g.createImageData(w, h), out = new Uint32Array(image.data.buffer);
  const word = ([r, gr, b]) => (255 << 24 | b << 16 | gr << 8 | r) >>> 0, low = rgb(theme.low), high = rgb(theme.high);
  out.fill(word(rgb(theme.map)));
  if ($("show-cloud").checked) {
    const table = Uint32Array.from({length: 256}, (_, i) => word(mix(low, high, i / 255))), {c, yaw, tilt} = view, s = view.scale * dpr;
    const cos = s * Math.cos(yaw), sin = s * Math.sin(yaw), ct = Math.cos(tilt), st = s * Math.sin(tilt);
    const dot = Math.ceil(dpr * clamp(Math.sqrt(view.scale) / 2, .9, 3));
    for (let i = 0, k = 0; i < C.count; i++, k += 3) {
      const dx = cloud[k] - c[0], dy = cloud[k + 1] - c[1], x = (w / 2 + cos * dx - sin * dy) | 0;
      const y = (h / 2 - (sin * dx + cos * dy) * ct - st * (cloud[k + 2] - c[2])) | 0;
      if (x < 0 || y < 0 || x >= w - dot || y >= h - dot) continue;
      for (let b = 0; b < dot; b++) for (let a = 0; a < dot; a++) out[(y + b) * w + x + a] = table[levels[i]];
    }
  }
  g.putImageData(image, 0, 0);
}
function line(track, colour, width, dash = []) {
  g.beginPath();
  for (let i = 0; i < track[0].length; i++) g.lineTo(...project(at(track, i)));
  Object.assign(g, {strokeStyle: colour, lineWidth: width}); g.setLineDash(dash); g.stroke(); g.setLineDash([]);
}
function drawTrack() {
  const spots = D.t.map((_, i) => project(at(D.track, i)));
  Object.assign(g, {lineCap: "round", lineJoin: "round"});
  if (D.truth && $("show-truth").checked) line(D.truth, theme.truth, 9);
  line(D.track, theme.map, 5.5);
  for (let i = 1, begin = 0; i < N; i++) {  // one stroke for neighbours of one colour
    if (i < N - 1 && colourOf(i + 1) === colourOf(i)) continue;
    g.beginPath();
    for (let k = begin; k <= i; k++) g.lineTo(...spots[k]);
    Object.assign(g, {strokeStyle: colourOf(i), lineWidth: 3.2}); g.stroke(); begin = i;
  }
  if (D.refined && $("show-refined").checked) line(D.refined, theme.refined, 1.6, [6, 5]);
  drawEllipses(spots);
  D.status.forEach((s, i) => s && mark(s, ...spots[i]));
  if (view.scale * quantile(D.speed, .5) * .1 > 14) spots.forEach(([x, y], i) => D.status[i] || disc(x, y, 3.2, colourOf(i)));
}
function disc(x, y, r, colour) {
  g.beginPath(); g.arc(x, y, r, 0, TAU);
  Object.assign(g, {fillStyle: colour, strokeStyle: theme.map, lineWidth: 1.2}); g.fill(); g.stroke();
}
function mark(status, x, y) {
  const shape = {1: [[0, -6], [6, 5], [-6, 5]], 2: [[0, -6.5], [6, 0], [0, 6.5], [-6, 0]]}[status];
  Object.assign(g, {strokeStyle: theme.map, fillStyle: theme.status[status], lineWidth: 1.5}); g.beginPath();
  if (shape) {
    for (const [dx, dy] of shape) g.lineTo(x + dx, y + dy);
    return g.closePath(), g.fill(), g.stroke();
  }
  for (const [dx, dy] of [[5, 5], [5, -5]]) { g.moveTo(x - dx, y - dy); g.lineTo(x + dx, y + dy); }
  g.lineWidth = 5; g.stroke(); Object.assign(g, {strokeStyle: theme.status[status], lineWidth: 2.8}); g.stroke();
}
const usual = 2 * quantile(D.ellipse[0].map((xx, i) => xx === null ? null : Math.sqrt(xx + D.ellipse[2][i])), .9);  // [m]
const automatic = () => [1, 10, 100, 1000].find(f => f * usual * view.scale > 9) || 1000;
const factor = () => $("ellipse").value === "auto" ? automatic() : +$("ellipse").value;
function drawEllipses(spots) {
  const f = factor(), [xx, xy, yy] = D.ellipse;
  if (!f || !certain) return;
  let last = [-1e9, 0], clear = 0;  // they keep clear of each other
  Object.assign(g, {strokeStyle: theme.ink, lineWidth: 1, fillStyle: theme.band, globalAlpha: 1});
  for (let i = N - 1; i >= 0; i--) {
    if (xx[i] === null || Math.hypot(spots[i][0] - last[0], spots[i][1] - last[1]) < clear) continue;
    const a = (xx[i] + yy[i]) / 2, d = (xx[i] - yy[i]) / 2, r = Math.hypot(d, xy[i]), turn = Math.atan2(xy[i], d) / 2;
    const [x, y, z] = at(D.track, i);
    const p = 2 * f * Math.sqrt(Math.max(a + r, 0)), q = 2 * f * Math.sqrt(Math.max(a - r, 0)), cos = Math.cos(turn), sin = Math.sin(turn);
    last = spots[i]; clear = Math.max(55, .9 * p * view.scale);
    if (p * view.scale < 1.5 || (f > 1 && p * view.scale > W / 2)) continue;
    g.beginPath();
    for (let k = 0; k <= 48; k++) {
      const u = p * Math.cos(TAU * k / 48), v = q * Math.sin(TAU * k / 48);
      g.lineTo(...project([x + cos * u - sin * v, y + sin * u + cos * v, z]));
    }
    g.globalAlpha = .14; g.fill(); g.globalAlpha = .75; g.stroke(); g.globalAlpha = 1;
  }
}
function label(text, x, y, align = "left") {
  Object.assign(g, {font: "600 12px system-ui, sans-serif", textAlign: align, fillStyle: theme.ink, strokeStyle: theme.map, lineWidth: 4});
  g.strokeText(text, x, y); g.fillText(text, x, y);
}
function drawFurniture() {
  const start = project(at(D.track, 0)), end = project(at(D.track, N - 1)), near = Math.hypot(start[0] - end[0], start[1] - end[1]) < 40;
  Object.assign(g, {fillStyle: theme.ink, strokeStyle: theme.map, lineWidth: 1.5});
  g.beginPath(); g.rect(start[0] - 5, start[1] - 5, 10, 10); g.fill(); g.stroke(); label("start", start[0], start[1] + 22, "center");
  if (N > 1) { disc(...end, 5.5, theme.ink); label("end", end[0], end[1] + (near ? -14 : 22), "center"); }
  const most = 130 / view.scale, power = 10 ** Math.floor(Math.log10(most)), long = [5, 2, 1].find(k => k * power <= most) * power;
  Object.assign(g, {strokeStyle: theme.ink, lineWidth: 2}); g.beginPath();
  for (const [x, y] of [[0, 24], [0, 18], [long, 18], [long, 24]]) g.lineTo(16 + x * view.scale, H - y);
  g.stroke();
  label(long >= 1000 ? `${long / 1000} km` : long >= 1 ? `${long} m` : `${short(100 * long)} cm`, 22, H - 25);
}
function paint() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}
function draw() {
  if (!view) return;
  if (shown !== factor()) { shown = factor(); legend(); }
  g.setTransform(1, 0, 0, 1, 0, 0); drawCloud(); g.setTransform(dpr, 0, 0, dpr, 0, 0); drawTrack(); drawFurniture(); drawCar();
}
function drawCar() {
  const here = at(D.track, current), yaw = D.yaw[current], heading = [Math.cos(yaw), Math.sin(yaw), 0];
  const ahead = here.map((v, k) => v + heading[k] / view.scale);
  const [x, y] = project(here), [u, v] = project(ahead);
  $("car").hidden = false; $("car").style.transform = `translate(${x}px,${y}px) rotate(${Math.atan2(v - y, u - x)}rad)`;
}
function zoom(by, x = W / 2, y = H / 2) {
  const before = ground(x - W / 2, y - H / 2);
  view.scale = clamp(view.scale * by, .01, 2000);
  const after = ground(x - W / 2, y - H / 2);
  view.c[0] += before[0] - after[0]; view.c[1] += before[1] - after[1]; paint();
}
function pan(dx, dy) { const [x, y] = ground(dx, dy); view.c[0] -= x; view.c[1] -= y; paint(); }
function say(text) {
  $("hint").textContent = text; $("hint").hidden = false;
  clearTimeout(say.timer); say.timer = setTimeout(() => $("hint").hidden = true, 1800);
}
function pick(x, y, reach) {
  let best = -1, least = reach;
  for (let i = 0; i < N; i++) {
    const [u, v] = project(at(D.track, i)), far = Math.hypot(u - x, v - y);
    if (far < least) { best = i; least = far; }
  }
  if (best >= 0) select(best);
}
const fingers = new Map();
let moved = 0;
const place = e => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
canvas.addEventListener("pointerdown", e => {
  canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, place(e));
  moved = fingers.size > 1 ? 99 : 0;
});
canvas.addEventListener("pointermove", e => {
  const [x, y] = place(e), before = fingers.get(e.pointerId);
  if (!before) return e.pointerType === "mouse" && !playing && pick(x, y, 24);
  const [dx, dy] = [x - before[0], y - before[1]], other = [...fingers].find(([id]) => id !== e.pointerId);
  moved += Math.hypot(dx, dy); fingers.set(e.pointerId, [x, y]);
  if (other) {  // two fingers: move, zoom and turn
    const [ox, oy] = other[1], was = [before[0] - ox, before[1] - oy], is = [x - ox, y - oy];
    view.yaw -= Math.atan2(is[1], is[0]) - Math.atan2(was[1], was[0]);
    zoom(Math.hypot(...is) / Math.max(Math.hypot(...was), 1), ox, oy); pan(dx / 2, dy / 2);
  } else if (view.tilt && !e.shiftKey) { view.yaw += dx / 150; view.tilt = clamp(view.tilt - dy / 200, .05, 1.5); paint(); }
  else if (moved > 5) pan(dx, dy);
});
for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, e => {
  fingers.delete(e.pointerId);
  if (name === "pointerup" && moved < 6) pick(...place(e), e.pointerType === "mouse" ? 24 : 44);
});
canvas.addEventListener("wheel", e => {
  if (document.activeElement !== canvas && !e.ctrlKey) return say("Click the map; then the wheel zooms");
  e.preventDefault(); zoom(Math.exp(-e.deltaY * (e.ctrlKey ? .01 : .0018)), ...place(e));
}, {passive: false});
canvas.addEventListener("pointerleave", e => e.pointerType === "mouse" && canvas.blur());
canvas.addEventListener("keydown", e => {
  const does = {"+": () => zoom(1.3), "=": () => zoom(1.3), "-": () => zoom(1 / 1.3), 0: fit, ArrowLeft: () => pan(60, 0),
    ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60), Escape: () => canvas.blur()}[e.key];
  if (does) { e.preventDefault(); does(); }
});
$("closer").onclick = () => zoom(1.5); $("farther").onclick = () => zoom(1 / 1.5); $("fit").onclick = fit;
$("tilt").onclick = () => {
  view.tilt = view.tilt ? 0 : .95; $("tilt").setAttribute("aria-pressed", !!view.tilt); paint();
  if (view.tilt) say("Drag to turn; shift and drag, or two fingers, to move");
};
