// CA and PSNR against the step: two charts with one range of steps and one cursor.
const SVG = make("div", { innerHTML: "<svg/>" }).firstChild.namespaceURI;
const svg = (tag, attributes, ...children) => {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
};
const steps = [...new Set(data.curves.flatMap(curve => curve.step))].sort((a, b) => a - b);
const groups = [...new Set(data.curves.map(curve => curve.group))], charts = [], off = new Set();
const whole = [steps[0], steps.at(-1) > steps[0] ? steps.at(-1) : steps[0] + 1];
let range = whole, cursor = null; // the steps that are shown, and one of them
const DASHES = ["", "2 4", "7 4", "7 3 2 3"], dash = group => DASHES[(groups.length - 1 - groups.indexOf(group)) % 4];
const LEFT = 42, RIGHT = 10, BOTTOM = 34, HEIGHT = 260;
const shownCurves = () => data.curves.filter(({ run, group }) => !off.has(run) && !off.has(group));
const colorOf = label => data.runs.find(run => run.label === label).color;

function ticks(low, high, most) {
  const raw = (high - low) / most || 1, unit = 10 ** Math.floor(Math.log10(raw));
  const by = unit * [1, 2, 5, 10].find(times => times * unit >= raw), found = [];
  for (let i = Math.ceil(low / by - 1e-9); i * by <= high + 1e-9 * by; i++) found.push(Number((i * by).toPrecision(6)));
  return found;
}

function drawChart({ key, title, box }) {
  const width = Math.max(260, box.parentElement.clientWidth), [x0, x1] = range, curves = shownCurves();
  const inside = curves.flatMap(({ step, [key]: y }) => y.filter((v, i) => v !== null && step[i] >= x0 && step[i] <= x1));
  const top = Math.max(...inside), least = key === "ca" ? 0 : Math.min(...inside), pad = 0.05 * (top - least) || 0.5;
  const low = key === "ca" ? 0 : least - pad, high = top + pad;
  const x = step => LEFT + (step - x0) / (x1 - x0) * (width - LEFT - RIGHT);
  const y = value => HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - BOTTOM - 8);
  box.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
  box.replaceChildren();
  box.append(svg("text", { x: LEFT + (width - LEFT) / 2, y: HEIGHT - 3, "text-anchor": "middle" }, "step"));
  if (!inside.length) return void box.append(svg("text", { x: LEFT, y: 40 }, "Nothing to show."));
  for (const value of ticks(low, high, 5)) box.append(
    svg("line", { x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value), class: "rule" }),
    svg("text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, value));
  for (const step of ticks(x0, x1, width / 90))
    box.append(svg("text", { x: x(step), y: HEIGHT - 18, "text-anchor": x(step) > width - 25 ? "end" : "middle" }, step.toLocaleString("en")));
  const edge = LEFT - 3, inner = width - LEFT - RIGHT + 6; // an inner picture cuts what is out of the range
  const lines = svg("svg", { x: edge, width: inner, height: HEIGHT, viewBox: `${edge} 0 ${inner} ${HEIGHT}` });
  for (const { run, group, step, [key]: values } of curves) {
    const points = step.map((s, i) => [x(s), values[i]]).filter(([, value]) => value !== null);
    lines.append(svg("path", { d: points.map(([at, value], i) => `${i ? "L" : "M"}${at} ${y(value)}h0`).join(""),
      stroke: colorOf(run), "stroke-dasharray": dash(group), class: "curve" }));
  }
  box.append(lines);
  Object.assign(box, { toStep: at => x0 + (at / box.clientWidth * width - LEFT) / (width - LEFT - RIGHT) * (x1 - x0) });
  if (cursor === null || cursor < x0 || cursor > x1) return;
  box.append(svg("line", { x1: x(cursor), x2: x(cursor), y1: 8, y2: HEIGHT - BOTTOM, class: "cursor" }));
  for (const { run, step, [key]: values } of curves) {
    const value = values[step.indexOf(cursor)];
    if (value != null) box.append(svg("circle", { cx: x(cursor), cy: y(value), r: 4, fill: colorOf(run) }));
  }
}

function drawCharts() {
  charts.forEach(drawChart);
  $("zoomed").disabled = range === whole;
  $("readout").replaceChildren();
  if (cursor === null) return $("readout").append("Point at a curve, or use the arrow keys, to read it; drag to zoom in.");
  $("readout").append(`step ${cursor.toLocaleString("en")}: `, ...shownCurves().flatMap(({ run, group, step, ca, psnr }) => {
    const i = step.indexOf(cursor), found = [ca[i] != null ? `CA ${ca[i].toFixed(2)}` : "", psnr[i] != null ? `PSNR ${psnr[i].toFixed(2)}` : ""];
    return i < 0 ? [] : [make("span", { className: "key" }, swatch(colorOf(run)), `${run}, ${group}: ${found.filter(Boolean).join(", ")}`)];
  }));
}

function addCharts() {
  const toggle = (name, ...shown) => make("button", { type: "button", className: "toggle", ariaPressed: "true", onclick: event => {
    off.has(name) ? off.delete(name) : off.add(name);
    event.currentTarget.ariaPressed = String(!off.has(name));
    drawCharts();
  } }, ...shown);
  const pattern = group => svg("svg", { width: 26, height: 10, "aria-hidden": "true" }, svg("path", { d: "M1 5H25", class: "curve", stroke: "currentColor", "stroke-dasharray": dash(group) }));
  const zoomed = make("button", { id: "zoomed", type: "button", onclick: () => { range = whole; drawCharts(); } }, "whole range");
  $("dynamics").append(make("div", { className: "controls" },
    ...[...new Set(data.curves.map(curve => curve.run))].map(run => toggle(run, swatch(colorOf(run)), run)),
    ...groups.map(group => toggle(group, pattern(group), group)), zoomed), make("div", { className: "side charts" }),
    make("p", { id: "readout", className: "quiet", ariaLive: "polite" }));
  for (const [key, title] of [["ca", `${data.exact ? "exact CA" : "CA"} (1e-3)`], ["psnr", "PSNR (dB)"]]) {
    const box = svg("svg", { tabindex: 0, role: "img", "aria-label": `${title} against the step` }), chart = { key, title, box };
    let from = null;
    const nearest = event => {
      const at = box.toStep?.(event.offsetX);
      return steps.reduce((a, b) => (Math.abs(b - at) < Math.abs(a - at) ? b : a));
    };
    box.onpointerdown = event => { from = nearest(event); box.setPointerCapture(event.pointerId); };
    box.onpointermove = event => { cursor = nearest(event); drawCharts(); };
    box.onpointerup = event => {
      const ends = [from, nearest(event)].sort((a, b) => a - b);
      if (from !== null && ends[1] > ends[0]) range = ends;
      from = null;
      drawCharts();
    };
    box.onpointerleave = () => { cursor = null; drawCharts(); };
    box.onkeydown = ({ key: pressed }) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[pressed], at = steps.indexOf(cursor);
      if (!by) return;
      cursor = steps[Math.max(0, Math.min(steps.length - 1, at + by))];
      drawCharts();
    };
    charts.push(chart);
    $("dynamics").querySelector(".charts").append(make("figure", {}, make("figcaption", {}, title), box));
  }
  new ResizeObserver(drawCharts).observe($("dynamics"));
}
