// What is drawn over time, the frame that is chosen, and how everything starts; page_map.js stands before it.
const charts = [], LEFT = 46, RIGHT = 10, FOOT = 18, end = D.t[N - 1] || 1;
const ticks = (low, high, most) => {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find(k => k * power >= rough) * power;
  return Array.from({length: 12}, (_, i) => (Math.ceil(low / step - 1e-9) + i) * step).filter(v => v <= high + 1e-9 * step);
};
function chart(host, spec) {
  const figure = document.createElement("figure"), plot = document.createElement("div");
  figure.innerHTML = `<figcaption><div>${spec.title} <span>${spec.unit}${spec.note || ""}</span></div><output></output></figcaption>`;
  plot.className = "plot"; plot.innerHTML = `<canvas role=img aria-label="${spec.title} over time"></canvas><i></i>`;
  figure.append(plot); $(host).append(figure);
  const one = {...spec, plot, canvas: plot.firstChild, cursor: plot.lastChild, output: figure.querySelector("output")};
  const choose = e => {
    const box = plot.getBoundingClientRect(), t = end * clamp((e.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT), 0, 1);
    let low = 0, high = N - 1;
    while (high - low > 1) { const m = (low + high) >> 1; D.t[m] < t ? low = m : high = m; }
    select(t - D.t[low] < D.t[high] - t ? low : high);
  };
  plot.addEventListener("pointermove", choose); plot.addEventListener("pointerdown", choose);
  charts.push(one); new ResizeObserver(() => drawChart(one)).observe(plot);
}
function drawChart(one) {
  const w = one.plot.clientWidth, h = one.height, ratio = devicePixelRatio, c = one.canvas, k = c.getContext("2d");
  const [low, high] = one.range();
  if (!w) return;
  c.width = w * ratio; c.height = h * ratio; c.style.height = h + "px"; k.scale(ratio, ratio);
  const X = i => LEFT + (w - LEFT - RIGHT) * (D.t[i] / end), Y = v => 8 + (h - FOOT - 12) * (1 - (v - low) / (high - low || 1));
  Object.assign(k, {font: "11px system-ui, sans-serif", fillStyle: theme.soft, strokeStyle: theme.line});
  Object.assign(k, {textAlign: "right", textBaseline: "middle"});
  for (const v of one.plain ? [] : ticks(low, high, h > 100 ? 5 : 3)) {
    k.beginPath(); k.moveTo(LEFT, Y(v)); k.lineTo(w - RIGHT, Y(v)); k.stroke();
    k.fillText(short(Math.abs(v) < 1e-12 ? 0 : v), LEFT - 6, Y(v));
  }
  Object.assign(k, {textAlign: "center", textBaseline: "alphabetic"});
  for (const t of ticks(0, end, w / 90)) k.fillText(short(t) + " s", clamp(LEFT + (w - LEFT - RIGHT) * t / end, 0, w - 16), h - 4);
  k.save(); k.beginPath(); k.rect(LEFT, 0, w - LEFT - RIGHT, h - FOOT); k.clip();
  k.lineJoin = "round"; one.draw(k, X, Y, w, h); k.restore();
}
function curve(k, X, Y, values, colour, width = 1.5) {
  let open = false;
  k.beginPath();
  values.forEach((v, i) => { if (v === null) open = false; else { open ? k.lineTo(X(i), Y(v)) : k.moveTo(X(i), Y(v)); open = true; } });
  Object.assign(k, {strokeStyle: colour, lineWidth: width}); k.stroke();
}
function area(k, X, Y, upper, lower, colour, alpha) {
  const known = D.t.map((_, i) => i).filter(i => upper[i] !== null);
  k.beginPath(); known.forEach(i => k.lineTo(X(i), Y(upper[i]))); known.reverse().forEach(i => k.lineTo(X(i), Y(lower[i])));
  Object.assign(k, {fillStyle: colour, globalAlpha: alpha}); k.fill(); k.globalAlpha = 1;
}
const good = values => { const kept = values.filter((_, i) => D.status[i] < 2 && i > 0); return finite(kept).length ? kept : values; };
const reach = (values, q = .98) => 1.25 * quantile(good(values), q) || 1;

chart("overview", {title: sure ? "Status and confidence" : "Status", unit: "", height: sure ? 96 : 44, plain: !sure, range: () => [0, 1],
  draw(k, X, Y, w, h) {
    const bar = 9, foot = h - FOOT - bar, one = (w - LEFT - RIGHT) / N;
    if (sure) curve(k, X, Y, D.confidence, theme.ink);
    Object.assign(k, {fillStyle: theme.status[0], globalAlpha: .45}); k.fillRect(LEFT, foot, w, bar); k.globalAlpha = 1;
    D.status.forEach((s, i) => {
      k.fillStyle = theme.status[s];
      if (s) k.fillRect(X(i) - Math.max(one, 3) / 2, 4, Math.max(one, 3), foot + bar - 4);
    });
  },
  value: i => `${MARKS[D.status[i]]} ${words(D.statuses[D.status[i]])}${sure ? ", " + short(D.confidence[i]) : ""}`});
chart("overview", {title: "Speed", unit: "m/s", height: 96, range: () => [0, reach(D.speed, .99)],
  draw: (k, X, Y) => curve(k, X, Y, D.speed, theme.stage[0]), value: i => `${short(D.speed[i])} m/s`});
if (missed) chart("overview", {title: "Error of the position", unit: "cm", height: 110,
  note: missedRefined ? " · line: odometry, dashed: refined" : "",
  range: () => [0, 100 * Math.max(reach(missed, 1), missedRefined ? reach(missedRefined, 1) : 0)],
  draw(k, X, Y) {
    curve(k, X, Y, missed.map(v => 100 * v), theme.ink);
    if (missedRefined) { k.setLineDash([5, 4]); curve(k, X, Y, missedRefined.map(v => 100 * v), theme.refined, 1.8); k.setLineDash([]); }
  },
  value: i => metres(missed[i]) + (missedRefined ? ` → ${metres(missedRefined[i])}` : "")});
if (stages.length) chart("overview", {title: "Time per scan", unit: "ms", height: 120, range: () => [0, reach(total, .99)],
  note: stages.map((name, s) => ` <b style="color:var(--s${s % 5})">■</b> ${name}`).join(""),
  draw(k, X, Y) {
    let below = D.t.map(() => 0);
    stages.forEach((name, s) => {
      const above = below.map((v, i) => v + (D.timing[name][i] || 0));
      area(k, X, Y, above, below, theme.stage[s % 5], .85); below = above;
    });
  },
  value: i => `${short(total[i])} ms`});
let set = SETS[0];
const unitOf = axis => axis < 3 ? ["deg", 1] : quantile(good(set.sigma[axis]), .9) < .3 ? ["cm", 100] : ["m", 1];
if (certain) AXES.forEach((title, axis) => chart("axes", {title, unit: "", height: 130,
  range() {
    const [, f] = unitOf(axis), wide = 2.1 * quantile(good(set.sigma[axis]), .97);
    const off = set.error ? quantile(good(set.error[axis].map(v => v === null ? null : Math.abs(v))), .99) : 0;
    const most = f * Math.max(wide, 1.15 * off) || 1;
    return [-most, most];
  },
  draw(k, X, Y) {
    const [, f] = unitOf(axis), s = set.sigma[axis], times = n => s.map(v => v === null ? null : n * f * v);
    area(k, X, Y, times(2), times(-2), theme.band, .18); area(k, X, Y, times(1), times(-1), theme.band, .3);
    if (set.error) curve(k, X, Y, set.error[axis].map(v => v === null ? null : f * v), theme.error, 1.2);
  },
  value(i) {
    const [unit, f] = unitOf(axis), e = set.error && set.error[axis][i], s = set.sigma[axis][i];
    return (set.error ? `${short(e === null ? null : f * e)} ` : "") + `± ${short(s === null ? null : f * s)} ${unit}`;
  }}));
$("bands").hidden = !certain || N < 2;
SETS.forEach((one, i) => $("which").add(new Option(one.name, i)));
const key = (look, text) => `<i class="key" style="${look}"></i>${text}`;
const bandsKey = key("background:var(--band);opacity:.48", "±1σ") + key("background:var(--band);opacity:.18", "±2σ");
$("which").onchange = () => {
  set = SETS[$("which").value];
  $("bands-key").innerHTML = bandsKey + (set.error ? key("background:var(--error);height:2px;vertical-align:middle", "error") : "");
  charts.forEach(drawChart); select(current);
};

// ---- the frame that is chosen --------------------------------------------------------------------------------------------------------
const safe = text => text.replace(/[&<>"]/g, c => `&#${c.charCodeAt(0)};`);
const stamp = i => {  // to a microsecond; too long for a float
  const digits = (BigInt(D.stamp_ns) / 1000n + BigInt(Math.round(D.t[i] * 1e6))).toString().padStart(7, "0");
  return `${digits.slice(0, -6)}.${digits.slice(-6)} s`;
};
function details(i) {
  const s = D.status[i], rows = [["time", `${D.t[i].toFixed(2)} s`], ["speed", `${short(D.speed[i])} m/s`]], word = D.statuses[s];
  if (sure) rows.push(["confidence", short(D.confidence[i])]);
  if (missed) rows.push(["position error", metres(missed[i])]);
  if (missedRefined) rows.push(["refined error", metres(missedRefined[i])]);
  rows.push(["position", at(D.track, i).map(v => v.toFixed(1)).join(", ") + " m"], ["stamp", stamp(i)]);
  for (const name of stages) rows.push([name, `${short(D.timing[name][i])} ms`]);
  const head = SETS.map(one => `<th scope=col>${one.name.split(" ")[0]}</th>`).join("");
  const cell = (v, k) => `<td>${k < 3 ? brief(v) + "°" : metres(v, brief)}</td>`;
  const lines = AXES.map((name, k) => `<tr><th scope=row>${name}</th>${SETS.map(one => cell(one.sigma[k][i], k)).join("")}</tr>`).join("");
  const sigmas = certain ? `<table><tr><th scope=col>1σ</th>${head}</tr>${lines}</table>` : "";
  $("details").innerHTML = `<h3>Frame ${i} <b class="${word}">${MARKS[s]}</b> ${words(word)}</h3>` +
    (D.reason[i] ? `<p>${safe(D.reason[i])}</p>` : "") + `<dl>${rows.map(([a, b]) => `<dt>${a}</dt><dd>${b}</dd>`).join("")}</dl>${sigmas}`;
}
function select(i) {
  current = i; $("slider").value = i; details(i);
  $("slider").setAttribute("aria-valuetext", `frame ${i}, ${D.t[i].toFixed(1)} s, ${words(D.statuses[D.status[i]])}`);
  for (const one of charts) {
    const share = D.t[i] / end;
    one.cursor.style.left = `calc(${LEFT}px + (100% - ${LEFT + RIGHT}px) * ${share})`; one.output.textContent = one.value(i);
  }
  if (view) drawCar();
}
function show(i, near) {  // brings a frame into view
  const [x, y] = project(at(D.track, i)), inside = x > 30 && y > 30 && x < W - 30 && y < H - 30;
  if (near) view.scale = Math.max(view.scale, 8);
  if (near || !inside) { view.c = at(D.track, i); paint(); }
}
let playing = 0;
function step(now) {
  if (!playing) return;
  const rate = Math.max(1, end / 40);  // a long drive goes by in 40 s
  step.t += rate * (now - step.last) / 1000; step.last = now;
  let i = current;
  while (i < N - 1 && D.t[i + 1] <= step.t) i++;
  if (i !== current) { select(i); show(i); }
  i < N - 1 ? playing = requestAnimationFrame(step) : stop();
}
function stop() {
  cancelAnimationFrame(playing); playing = 0;
  $("play").textContent = "▶"; $("play").setAttribute("aria-label", "Play the drive");
}
$("play").onclick = () => {
  if (playing) return stop();
  if (current >= N - 1) select(0);
  step.t = D.t[current]; step.last = performance.now(); playing = requestAnimationFrame(step);
  $("play").textContent = "❚❚"; $("play").setAttribute("aria-label", "Stop");
};
$("slider").oninput = () => { stop(); select(+$("slider").value); show(current); };
for (const link of document.querySelectorAll("[data-frame]")) link.onclick = () => { select(+link.dataset.frame); show(current, true); };

// ---- controls and start --------------------------------------------------------------------------------------------------------------
const stroke = (colour, text, dash = "solid") =>
  `<span><i class="stroke" style="border-color:${colour};border-top-style:${dash}"></i>${text}</span>`;
const gradient = (a, text) => `<span><i class="ramp" style="background:linear-gradient(90deg,${a})"></i>${text}</span>`;
function legend() {
  const f = view ? factor() : 0, parts = [], full = v => short(v * (mode.scale || 1));
  if (mode.values) {
    parts.push(gradient([0, .25, .5, .75, 1].map(ramp).join(), `${mode.name}: ${full(mode.low)} to ${full(mode.high)} ${mode.unit}`));
  } else if (D.status.includes(0)) parts.push(stroke(theme.status[0], "ok"));
  for (const s of [1, 2, 3].filter(s => D.status.includes(s))) {
    parts.push(`<span><b class="${D.statuses[s]}">${MARKS[s]}</b>${words(D.statuses[s])}</span>`);
  }
  if (D.truth && $("show-truth").checked) parts.push(stroke(theme.truth, "truth"));
  if (D.refined && $("show-refined").checked) parts.push(stroke(theme.refined, "refined", "dashed"));
  if (f && certain) parts.push(`<span>◯ 2σ of the position${f > 1 ? `, drawn ${f} times as large` : ", true size"}</span>`);
  const heights = C.heights.map(v => v.toFixed(1)).join(" to ");
  if (C.count && $("show-cloud").checked) parts.push(gradient([theme.low, theme.high].join(), `points, ${heights} m above the sensor`));
  $("legend").innerHTML = parts.join("");
}
function repaint() {
  theme = {status: D.statuses.map(style), stage: [0, 1, 2, 3, 4].map(i => style("s" + i))};
  for (const name of ["map", "low", "high", "truth", "refined", "error", "band", "ink", "soft", "line"]) theme[name] = style(name);
  legend(); paint(); charts.forEach(drawChart);
}
MODES.forEach((one, i) => $("colour").add(new Option(one.name, i)));
$("colour").onchange = () => { mode = MODES[$("colour").value]; repaint(); };
for (const id of ["ellipse", "show-cloud", "show-truth", "show-refined"]) $(id).onchange = () => { legend(); paint(); };
$("truth-label").hidden = !D.truth; $("refined-label").hidden = !D.refined; $("ellipse-label").hidden = !certain;
const screen = new ResizeObserver(() => {
  const box = canvas.getBoundingClientRect(), first = !view || W < 2;
  W = box.width; H = box.height; dpr = Math.min(devicePixelRatio || 1, 2); canvas.width = W * dpr; canvas.height = H * dpr;
  first ? fit() : paint();
});
dark.addEventListener("change", repaint); matchMedia("print").addEventListener("change", () => { repaint(); draw(); });
repaint(); screen.observe(canvas); $("which").onchange(); select(N - 1);
