"use strict";
// Draws and filters what content.py computed. Text goes in by textContent alone: names come from strangers' files.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = id => document.getElementById(id);
// Okabe and Ito's palette, safe for colour-blind readers; dashes and shapes differ as well.
const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot"];
const SHAPES = ["circle", "square", "triangle-up", "diamond", "triangle-down", "cross"];
const FIRST_ROWS = 400;
// Marks in the chart of costs: more are a cloud without names, and take a browser minutes.
const MOST_MARKS = 100;
const few = names => names.slice(0, 20).join(", ") + (names.length > 20 ? ` and ${names.length - 20} more` : "");
const ALL = "all scenes";

function element(tag, text, attributes) {
  const made = document.createElement(tag);
  if (text !== undefined && text !== null) made.textContent = text;
  for (const [name, value] of Object.entries(attributes || {})) made.setAttribute(name, value);
  return made;
}
function fill(select, values, chosen) {
  select.replaceChildren(...values.map(([value, text]) => element("option", text, { value })));
  if (chosen !== undefined) select.value = chosen;
}
// A chart's text is a small markup of its own.
const plain = text => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;");
const labels = [...new Set(data.groups.flatMap(group => group.entries).concat((data.paper || { entries: [] }).entries.map(e => e.label)))].sort();
const look = label => {
  const n = Math.max(0, labels.indexOf(label));
  const turn = n + Math.floor(n / COLOURS.length);
  return { colour: COLOURS[n % COLOURS.length], dash: DASHES[turn % DASHES.length], shape: SHAPES[turn % SHAPES.length] };
};
const decimals = name => ({ lpips: 4, miou: 3, ssim: 4 })[name] ?? 2;
const number = (value, digits) => value === null || value === undefined ? "–" : value.toFixed(digits);
const seconds = value => value < 60 ? `${+value.toPrecision(2)} s` : value < 3600 ? `${+(value / 60).toPrecision(2)} min` : `${+(value / 3600).toPrecision(2)} h`;
const rgba = (hex, alpha) => `rgba(${parseInt(hex.slice(1, 3), 16)},${parseInt(hex.slice(3, 5), 16)},${parseInt(hex.slice(5, 7), 16)},${alpha})`;

function layout(more) {
  const style = getComputedStyle(document.documentElement);
  const ink = style.getPropertyValue("--ink").trim(), line = style.getPropertyValue("--line").trim();
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickcolor: line };
  const base = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink, family: "system-ui, sans-serif" },
    margin: { l: 64, r: 16, t: 16, b: 48 }, hovermode: "closest", legend: { orientation: "h", y: -0.18 },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: line, activecolor: ink },
  };
  return { ...base, ...more, xaxis: { ...axis, ...more.xaxis }, yaxis: { ...axis, ...more.yaxis } };
}
const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
function timeTicks(low, high) {
  const at = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 36000].filter(t => t >= low * .7 && t <= high * 1.4);
  return at.length < 2 ? {} : { tickvals: at, ticktext: at.map(seconds) };
}

const group = () => data.groups[+byId("group").value];

function overScenes(chosen) {
  const shared = chosen.shared_scenes, all = chosen.scenes.length;
  const scenes = shared.length === all ? `${all} scene${all === 1 ? "" : "s"}` : `${shared.length} of ${all} scenes, on which all of these methods ran (${shared.join(", ")})`;
  return scenes + (chosen.left_out.length ? `, without ${few(chosen.left_out)}` : "");
}
function drawCards() {
  const chosen = group();
  byId("cards").replaceChildren(...data.budgets.map((budget, n) => {
    const card = element("div", null, { class: "card" });
    card.append(element("h3", seconds(budget)));
    const list = element("dl");
    for (const name of data.quality) {
      const standing = chosen.standings[name][n];
      if (!standing || !standing.ranking.length) continue;
      const best = standing.ranking[0];
      list.append(element("dt", data.metrics[name].title));
      const cell = element("dd", `${best.label}, ${number(best.value, decimals(name))}`);
      const lead = standing.lead;
      if (lead) {
        const second = standing.ranking[1].label, by = number(Math.abs(lead.difference.value), decimals(name));
        const sure = lead.probability === null ? "too few scenes to tell" : `ahead in ${Math.round(100 * lead.probability)} % of resamplings`;
        cell.append(element("span", `${lead.difference.value >= 0 ? `by ${by} before ${second}` : `yet its plain mean is ${by} behind that of ${second}`}: ${sure}`, { class: "sure" }));
      } else cell.append(element("span", standing.ranking.length > 1 ? `no scene in common with ${standing.ranking[1].label}` : "no other has a state by then", { class: "sure" }));
      list.append(cell);
    }
    if (!list.children.length) list.append(element("dd", "no method has anything to show by then"));
    card.append(list);
    return card;
  }));
  byId("cards-note").textContent = `Inter-quartile mean over ${overScenes(chosen)} and all seeds, of what a method has after so much of its fit. ` +
    "A run that has nothing yet, or failed, shows what the control `nothing` does. Scenes told: " + chosen.told + ".";
}

function drawAnytime() {
  const chosen = group(), name = byId("anytime-metric").value, scene = byId("anytime-scene").value;
  const traces = [], place = data.quality.indexOf(name) + 1; // after the seconds
  if (scene === ALL) {
    for (const curve of chosen.curves[name]) {
      const { colour, dash } = look(curve.label);
      traces.push({ x: [...curve.x, ...curve.x.slice().reverse()], y: [...curve.high, ...curve.low.slice().reverse()], fill: "toself",
        fillcolor: rgba(colour, .13), line: { width: 0 }, mode: "lines", hoverinfo: "skip", showlegend: false, legendgroup: curve.label });
      traces.push({ x: curve.x, y: curve.y, name: plain(curve.label), legendgroup: curve.label, mode: "lines+markers", line: { color: colour, dash, width: 2.2, shape: "hv" },
        marker: { symbol: look(curve.label).shape, size: curve.x.map((_, n) => n === curve.x.length - 1 ? 9 : 0.1) },
        hovertemplate: `${plain(curve.label)}<br>%{x:.3g} s: %{y:.4g}<extra>${curve.runs} runs, ${curve.scenes} scenes</extra>` });
    }
  } else {
    const seen = new Set();
    data.runs.forEach((run, n) => {
      if (run.group !== +byId("group").value || run.control || run.scene !== scene || run.status !== "ok" || !(name in run.figures) || !("fit_seconds" in run.figures)) return;
      const states = run.course.filter(state => state[place] !== null).map(state => [state[0], state[place]]).concat([[run.figures.fit_seconds, run.figures[name]]]);
      const { colour, dash, shape } = look(run.label);
      traces.push({ x: states.map(s => s[0]), y: states.map(s => s[1]), name: plain(run.label), legendgroup: run.label, showlegend: !seen.has(run.label),
        mode: "lines+markers", line: { color: colour, dash, width: 1.5, shape: "hv" }, marker: { symbol: shape, size: 6 }, customdata: states.map(() => n),
        hovertemplate: `${plain(run.label)}, seed ${run.seed}<br>%{x:.3g} s: %{y:.4g}<extra></extra>` });
      seen.add(run.label);
    });
  }
  const xs = traces.flatMap(t => t.x), better = data.metrics[name].better === "higher" ? "higher is better →" : "← lower is better";
  Plotly.react("anytime", traces, layout({ xaxis: { type: "log", title: { text: "seconds of fitting (log scale)" }, ...timeTicks(Math.min(...xs), Math.max(...xs)) },
    yaxis: { title: { text: `${data.metrics[name].label}, ${better}` } } }), CONFIG).then(openPoint);
  const without = chosen.entries.filter(label => !chosen.left_out.includes(label) && !traces.some(t => t.legendgroup === label));
  const late = chosen.entries.filter(label => !data.runs.some(run => run.group === +byId("group").value && run.label === label && run.course.length));
  byId("anytime-note").textContent = traces.length
    ? "A line begins where every run has a value, and ends with the longest fit. " + (scene === ALL ? `Bands: 95% intervals. Over ${overScenes(chosen)}. ` : "A line per seed; marks are checkpoints, the last one the end. ") + (without.length ? `Not drawn, for want of figures or of room: ${few(without)}. ` : "") + (late.length ? `Without checkpoints, so that only the end is known: ${few(late)}.` : "")
    : "No run has this figure and a fit time.";
}

function points(x, y, scene) {
  const number = +byId("group").value, chosen = group();
  if (scene === ALL) return Object.keys(chosen.estimates).flatMap(label => {
    const { figures, runs, failed } = chosen.estimates[label];
    if (!Object.hasOwn(figures, x) || !Object.hasOwn(figures, y)) return [];
    const over = Math.min(figures[x].runs, figures[y].runs), note = `${runs} runs` + (failed ? `, ${failed} failed` : "") + (over < runs ? `; a figure is of ${over}` : "");
    return [{ label, failed, x: figures[x], y: figures[y], note, run: data.runs.findIndex(r => r.group === number && r.label === label) }];
  });
  const found = new Map(), failures = new Map();
  data.runs.forEach((run, n) => {
    if (run.group !== number || run.control || run.scene !== scene) return;
    if (run.status !== "ok") failures.set(run.label, (failures.get(run.label) || 0) + 1);
    if (run.status !== "ok" || !(x in run.figures) || !(y in run.figures)) return;
    if (!found.has(run.label)) found.set(run.label, []);
    found.get(run.label).push({ n, x: run.figures[x], y: run.figures[y] });
  });
  const median = values => { const s = values.slice().sort((a, b) => a - b), m = s.length >> 1; return s.length % 2 ? s[m] : (s[m - 1] + s[m]) / 2; };
  return [...found].map(([label, runs]) => ({ label, run: runs[0].n, failed: failures.get(label) || 0,
    note: `${runs.length} seed${runs.length === 1 ? "" : "s"}` + (failures.has(label) ? `, ${failures.get(label)} failed` : ""),
    x: { value: median(runs.map(r => r.x)), interval: [Math.min(...runs.map(r => r.x)), Math.max(...runs.map(r => r.x))] },
    y: { value: median(runs.map(r => r.y)), interval: [Math.min(...runs.map(r => r.y)), Math.max(...runs.map(r => r.y))] } }));
}
// Whoever failed in some runs stands on no front: what is left of it may be the easy ones.
function front(all, x, y) {
  const found = all.filter(p => !p.failed);
  const xs = data.metrics[x].better === "higher" ? -1 : 1, ys = data.metrics[y].better === "higher" ? -1 : 1;
  return found.filter((p, i) => !found.some((q, j) => j !== i && xs * q.x.value <= xs * p.x.value && ys * q.y.value <= ys * p.y.value &&
    (xs * q.x.value < xs * p.x.value || ys * q.y.value < ys * p.y.value || j < i))).sort((a, b) => xs * (a.x.value - b.x.value));
}
const bars = (found, key, colour) => ({ type: "data", symmetric: false, color: rgba(colour, .5), thickness: 1.2,
  array: found.map(p => p[key].interval ? p[key].interval[1] - p[key].value : 0), arrayminus: found.map(p => p[key].interval ? p[key].value - p[key].interval[0] : 0) });

function drawCost() {
  const x = byId("cost-x").value, y = byId("cost-y").value, scene = byId("cost-scene").value;
  const found = points(x, y, scene), best = front(found, x, y), traces = [];
  if (best.length) traces.push({ x: best.map(p => p.x.value), y: best.map(p => p.y.value), mode: "lines", line: { color: "#999999", width: 1.3, shape: data.metrics[x].better === "higher" ? "vh" : "hv" }, hoverinfo: "skip", name: "Pareto front" });
  const onFront = new Set(best), marks = [...best, ...found.filter(p => !onFront.has(p))].slice(0, MOST_MARKS), drawn = new Set(marks);
  for (const p of found.filter(p => drawn.has(p))) {
    const { colour, shape } = look(p.label);
    traces.push({ x: [p.x.value], y: [p.y.value], error_x: bars([p], "x", colour), error_y: bars([p], "y", colour), name: plain(p.label), mode: "markers",
      marker: { color: colour, symbol: p.failed ? `${shape}-open` : shape, size: 12 }, customdata: [p.run], hovertemplate: `${plain(p.label)}<br>%{x:.4g}, %{y:.4g}<extra>${plain(p.note)}</extra>` });
  }
  const chart = byId("cost");
  chart.front = best.map(p => p.label);
  Plotly.react(chart, traces, layout({ xaxis: { type: data.metrics[x].log ? "log" : "linear", title: { text: data.metrics[x].label + (data.metrics[x].log ? ", log scale" : "") } },
    yaxis: { title: { text: data.metrics[y].label } } }), CONFIG).then(openPoint);
  const filtered = data.metrics[y].filtered ? found.filter(p => Object.hasOwn(group().estimates, p.label) && group().estimates[p.label].mixed).map(p => p.label) : [];
  byId("cost-note").textContent = found.length
    ? (scene === ALL ? `Inter-quartile means with 95% intervals, over ${overScenes(group())}. ` : "Medians over seeds, from the least to the largest. ") + (found.some(p => p.failed) ? `Hollow marks: some runs failed; ${scene === ALL ? "these count with the quality of `nothing`" : "these are not in the median"}, and such a method is on no front. ` : "") + "A click opens a run." + (found.length > marks.length ? ` ${found.length - marks.length} more methods are in the table alone.` : "") + (filtered.length ? ` † ${filtered.join(", ")}: the figure rests on the filter of mixed methods.` : "")
    : "No run has both figures.";
}

function drawPaper() {
  if (!data.paper) return;
  const section = element("section"), chart = element("div", null, { class: "chart", id: "paper", role: "img", "aria-label": "Fit time against PSNR as the paper reports it" });
  section.append(element("h2", "As the paper reports it"), chart, element("p", `${data.paper.title}. Another machine, other scenes and an unpublished scorer: not to be compared with the charts above.`, { class: "note" }));
  byId("chase-title").closest("section").before(section);
  const traces = data.paper.entries.filter(e => e.psnr !== undefined).map(e => ({ x: [e.seconds], y: [e.psnr], mode: "markers", name: plain(e.label),
    marker: { symbol: look(e.label).shape + "-open", color: look(e.label).colour, size: 12, line: { width: 2 } }, hovertemplate: `${plain(e.label)}<br>%{x:.4g} s, %{y:.4g} dB<extra>as reported</extra>` }));
  const xs = traces.flatMap(t => t.x);
  Plotly.newPlot(chart, traces, layout({ xaxis: { type: "log", title: { text: "Fit time, log scale" }, ...timeTicks(Math.min(...xs), Math.max(...xs)) }, yaxis: { title: { text: "PSNR (dB)" } } }), CONFIG);
}

function openPoint(chart) {
  if (chart.listens) return;
  chart.listens = true;
  chart.on("plotly_click", event => { const run = event.points[0].customdata; if (run !== undefined && run >= 0) show([run]); });
}

function drawChases() {
  const found = group().chases[byId("chase-metric").value] || [], chased = new Set(found.map(c => c.label));
  const names = group().entries.filter(label => group().entries.length <= data.drawn || chased.has(label));
  const table = byId("chases"), head = element("tr");
  head.append(element("th", "row after column"), ...names.map(name => element("th", name)));
  table.replaceChildren(head, ...names.map(label => {
    const row = element("tr");
    row.append(element("th", label, { scope: "row" }), ...names.map(target => {
      if (target === label) return element("td", "");
      const chase = found.find(c => c.label === label && c.target === target);
      if (!chase) return element("td", "–");
      const text = `${chase.ratio === null ? "never" : `${+chase.ratio.toPrecision(2)}×`} (${chase.reached}/${chase.runs})`;
      return element("td", text, { class: chase.ratio === null ? "never" : chase.ratio < 1 ? "fast" : "" });
    }));
    return row;
  }));
}

function drawSummary() {
  const chosen = group(), names = ["psnr", "lpips", "miou", "spill", "jitter_error", "fit_seconds", "peak_memory_bytes", "storage_bytes", "render_fps"];
  const kept = chosen.entries.filter(label => Object.hasOwn(chosen.estimates, label));
  const shown = names.filter(name => kept.some(label => Object.hasOwn(chosen.estimates[label].figures, name)));
  const head = element("tr");
  head.append(element("th", "method"), element("th", "runs"), ...shown.map(name => element("th", data.metrics[name].label)), element("th", "hypervolume"));
  const cell = (found, digits, runs) => {
    const made = element("td", found ? number(found.value, digits) : "–");
    if (found && found.runs < runs) made.append(element("small", `${found.runs} of ${runs} runs`));
    if (found && found.interval) made.append(element("small", `${number(found.interval[0], digits)} to ${number(found.interval[1], digits)}`));
    return made;
  };
  byId("summary-note").textContent = `Over ${overScenes(chosen)}.`;
  byId("summary").replaceChildren(head, ...kept.map(label => {
    const { figures, runs, failed, mixed } = chosen.estimates[label], row = element("tr");
    const count = element("td", `${runs}` + (failed ? `, ${failed} failed` : ""));
    row.append(element("th", label + (mixed ? " †" : ""), { scope: "row" }), count);
    for (const name of shown) row.append(cell(figures[name], { psnr: 2, lpips: 4, miou: 3, spill: 3, jitter_error: 4, fit_seconds: 0, peak_memory_bytes: 0, storage_bytes: 1, render_fps: 1 }[name], runs));
    row.append(cell(chosen.hypervolumes[label], 3, runs));
    return row;
  }));
}

// --- the table
const COLUMNS = [["scene", "scene"], ["label", "method"], ["preset", "preset"], ["seeds", "seeds"], ["status", "status"],
  ...(data.rows.some(row => row.verified) ? [["verified", "verified"]] : []), ...data.columns.map(name => [name, data.metrics[name].label]), ["told", "told"]];
let sorted = { column: null, ascending: true }, everything = false;

function filtered() {
  const text = byId("search").value.toLowerCase();
  const wanted = ["scene", "method", "preset", "machine", "told", "status"].map(name => [name, byId(`filter-${name}`).value]).filter(([, value]) => value !== "");
  return data.rows.filter(row => wanted.every(([name, value]) => row[name] === value) && (byId("filter-controls").checked || !row.control) &&
    (!text || [row.scene, row.label, row.preset, row.machine, row.told, row.status, row.settings, row.digest].some(t => t.toLowerCase().includes(text))));
}
function drawRows() {
  const rows = filtered();
  if (sorted.column) {
    const numeric = data.columns.includes(sorted.column), sign = sorted.ascending ? 1 : -1;
    const key = row => numeric ? (row.cells[sorted.column] || [null])[0] : row[sorted.column];
    rows.sort((a, b) => {
      const [p, q] = [key(a) ?? null, key(b) ?? null];
      if (p === null || q === null) return (p === null) - (q === null); // what has no figure comes last, either way
      return sign * (numeric ? p - q : p.localeCompare(q, "en", { numeric: true }));
    });
  }
  const shown = everything ? rows : rows.slice(0, FIRST_ROWS);
  byId("rows").tBodies[0].replaceChildren(...shown.map(row => {
    const line = element("tr", null, { class: [row.control ? "control" : "", row.status === "ok" ? "" : "failed"].join(" ").trim() });
    const first = element("td"), open = element("button", row.scene, { title: `scene ${row.digest}` });
    first.append(open);
    line.append(first);
    for (const [name] of COLUMNS.slice(1)) line.append(element("td", data.columns.includes(name) ? (row.cells[name] || [0, "–"])[1] : row[name], data.columns.includes(name) ? {} : name === "told" ? { class: "text told", title: row.told } : { class: "text" }));
    line.addEventListener("click", () => show(row.runs, row));
    return line;
  }));
  byId("table-count").textContent = `${rows.length} of ${data.rows.length} rows` + (shown.length < rows.length ? `, the first ${shown.length} shown` : "");
  byId("more").hidden = shown.length === rows.length;
}
function sortBy(column) {
  const better = (data.metrics[column] || {}).better;
  sorted = { column, ascending: sorted.column === column ? !sorted.ascending : better !== "higher" };
  for (const cell of byId("rows").tHead.rows[0].cells) cell.setAttribute("aria-sort", cell.dataset.column === column ? (sorted.ascending ? "ascending" : "descending") : "none");
  drawRows();
}

// --- a run's details
function show(numbers, row) {
  const runs = numbers.map(n => data.runs[n]), run = runs[0], box = byId("details-content");
  const about = row || data.rows.find(r => r.runs.includes(numbers[0]));
  box.replaceChildren(element("h2", `${run.label} on ${run.scene}`));
  box.append(element("p", `${about.machine} · protocol ${about.protocol} · told: ${about.told} · version ${about.version}, settings ${about.settings}`, { class: "note" }));
  for (const one of runs) {
    if (runs.length > 1) box.append(element("h3", `seed ${one.seed}`));
    if (one.status !== "ok") box.append(element("p", `${one.status}: ${one.reason}`, { class: "failed" }));
    box.append(element("pre", one.command));
    const figures = data.columns.filter(name => name in one.figures).map(name => `${data.metrics[name].label} ${one.figures[name]}`);
    if (figures.length) box.append(element("p", figures.join(" · ")));
    stages(box, one);
    for (const [name, text] of Object.entries(one.notes)) box.append(element("p", `${name}: ${text}`, { class: "note" }));
    decisions(box, one);
    if (one.verification) box.append(element("p", `scored again: ${one.verification}`, { class: "note" }));
    for (const reason of one.missing) box.append(element("p", `no figure: ${reason}`, { class: "note" }));
    if (one.sheet) box.append(element("img", null, { src: one.sheet, alt: `truth, render and opacity of ${one.label}, seed ${one.seed}`, loading: "lazy" }));
    box.append(element("p", `result ${one.file}, submission ${one.submission}`, { class: "note" }));
  }
  const settings = data.settings[about.settings];
  if (settings && Object.keys(settings).length) {
    const more = element("details");
    more.append(element("summary", "all settings"), element("pre", JSON.stringify(settings, null, 1)));
    box.append(more);
  }
  byId("details").showModal();
}
function decisions(box, run) {
  for (const decision of run.decisions) {
    const made = element("details", null, { class: "decision" }), table = element("table"), head = element("tr");
    made.append(element("summary", `${decision.name}: ${decision.chosen}`), element("p", decision.because, { class: "note" }));
    head.append(...decision.header.map(title => element("th", title, { scope: "col" })));
    table.append(head, ...decision.rungs.map((cells, n) => {
      const row = element("tr", null, n === decision.held ? { class: "held", title: "chosen" } : {});
      row.append(...cells.map(cell => element("td", cell)));
      return row;
    }));
    if (decision.rungs.length) made.append(table);
    if (decision.rungs_left_out) made.append(element("p", `rungs left out: ${decision.rungs_left_out}`, { class: "note" }));
    box.append(made);
  }
  if (run.decisions_left_out) box.append(element("p", `decisions left out: ${run.decisions_left_out}`, { class: "note" }));
}
function stages(box, run) {
  const parts = Object.entries(run.stages).filter(([, s]) => s > 0), total = parts.reduce((sum, [, s]) => sum + s, 0);
  if (!parts.length) return;
  const bar = element("div", null, { class: "stages", role: "img", "aria-label": "stages of the fit: " + parts.map(([name, s]) => `${name} ${seconds(s)}`).join(", ") });
  parts.forEach(([name, s], n) => bar.append(element("span", `${name} ${seconds(s)}`, { style: `flex: ${s / total} 1 0; background: ${COLOURS[n % COLOURS.length]}`, title: `${name}: ${seconds(s)}` })));
  box.append(bar);
}

// --- set up
function drawGroup() {
  const scenes = [[ALL, ALL], ...group().scenes.map(scene => [scene, scene])];
  fill(byId("anytime-scene"), scenes, ALL);
  fill(byId("cost-scene"), scenes, ALL);
  drawCards(); drawAnytime(); drawCost(); drawChases(); drawSummary();
}
fill(byId("group"), data.groups.map((g, n) => [n, `${g.machine} · protocol ${g.protocol} · told: ${g.told}`]), "0");
// The group with the most runs comes first to the eye.
const runsOf = g => Object.values(g.estimates).reduce((sum, entry) => sum + entry.runs, 0);
byId("group").value = String(data.groups.reduce((best, g, n) => runsOf(g) > runsOf(data.groups[best]) ? n : best, 0));
fill(byId("anytime-metric"), data.quality.map(n => [n, data.metrics[n].title]), data.quality[0]);
fill(byId("cost-x"), data.costs.map(n => [n, data.metrics[n].title]), "fit_seconds");
fill(byId("cost-y"), data.qualities.map(n => [n, data.metrics[n].title]), "psnr");
for (const name of ["scene", "method", "preset", "machine", "told", "status"]) {
  const values = [...new Set(data.rows.map(row => row[name]))].sort();
  fill(byId(`filter-${name}`), [["", "any"], ...values.map(v => [v, v])], "");
  byId(`filter-${name}`).addEventListener("change", drawRows);
}
const heading = element("tr");
for (const [name, title] of COLUMNS) {
  const cell = element("th", null, { "data-column": name, "aria-sort": "none", scope: "col" }), button = element("button", title);
  button.addEventListener("click", () => sortBy(name));
  cell.append(button);
  heading.append(cell);
}
byId("rows").tHead.append(heading);
byId("group").addEventListener("change", drawGroup);
for (const id of ["anytime-metric", "anytime-scene"]) byId(id).addEventListener("change", drawAnytime);
for (const id of ["cost-x", "cost-y", "cost-scene"]) byId(id).addEventListener("change", drawCost);
byId("chase-metric").addEventListener("change", drawChases);
byId("search").addEventListener("input", drawRows);
byId("filter-controls").addEventListener("change", drawRows);
byId("more").addEventListener("click", () => { everything = true; drawRows(); });
byId("details-close").addEventListener("click", () => byId("details").close());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawAnytime(); drawCost(); });
addEventListener("beforeprint", () => { everything = true; drawRows(); for (const id of ["anytime", "cost"]) Plotly.Plots.resize(byId(id)); });
drawGroup();
drawRows();
drawPaper();
