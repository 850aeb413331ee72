
// Definitions: a hint wherever a title has the word, the first that fits; a list at the end.
const TERMS = {
  "neutral": "The exact CA with every pixel composited on its own expected color, so that the background does not count.",
  "std error": "The standard error of the sampled CA beside it.",
  "exact CA": "Co-adaptation: the variance of the color of a pixel when half of the Gaussians (or the stated drop rate) are "
    + "left out at random, averaged over the pixels that count, computed exactly and not by sampling. In thousandths; "
    + "less is better if the quality is no worse.",
  "CA (": "Co-adaptation estimated from a few random renders, as in the paper. Noisy; compare models by the exact CA.",
  "expected PSNR": "What the model and the training photographs let expect of a view that has no photograph; so not of the "
    + "training views. Below it, or beside it as from and to, where the measured PSNR of a view lies in 80 % of the cases. "
    + "It does not rank models: one trained without dropout expects too much of itself.",
  "PSNR": "Peak signal-to-noise ratio against the photograph, in dB. Higher is better; 1 dB is a fifth less squared error.",
  "SSIM": "Structural similarity to the photograph, at most 1. Higher is better.",
  "LPIPS": "Perceptual distance to the photograph, by a neural network. Lower is better.",
  "CV": "Variance of the colors that are blended at a pixel, averaged over the pixels with a Gaussian.",
  "visible": "Share of the pixels that count for the sampled CA.",
  "covered": "Mean opacity of the picture: 1 where Gaussians cover it all.",
  "Gaussians": "Number of Gaussians of the model.",
  "seconds": "Time of the training on the machine it ran on.",
  "half is held by": "The fewest Gaussians that together hold half of the exact CA, as a share of all.",
  "held by": "Share of the exact CA that these Gaussians hold, those first that hold most.",
};
let hint = null; // whose definition is shown
function show() {
  const { left, bottom } = hint.getBoundingClientRect(), text = hint.ariaDescription;
  Object.assign($("tip"), { textContent: text, hidden: false });
  $("tip").style.top = `${bottom + 4}px`;
  $("tip").style.left = `${Math.max(4, Math.min(left, innerWidth - $("tip").offsetWidth - 8))}px`;
}
const unshow = () => { $("tip").hidden = true; hint = null; };
addEventListener("keydown", event => { if (event.key === "Escape") unshow(); });
addEventListener("scroll", () => { if (hint) show(); }, true);
function hinted(title, ...shown) {
  const text = TERMS[Object.keys(TERMS).find(term => title.includes(term))];
  if (!text) return [...shown];
  const made = make("button", { className: "hint", type: "button", ariaDescription: text }, ...shown);
  made.onmouseenter = made.onfocus = made.onclick = () => { hint = made; show(); };
  made.onmouseleave = made.onblur = unshow;
  return [made];
}
for (const [term, text] of Object.entries(TERMS))
  $("terms").append(make("dt", {}, term.replace(" (", "")), make("dd", {}, text));

const grid = (head, rows, label) => make("div", { className: "scroll", tabIndex: 0, role: "region", ariaLabel: label },
  make("table", {}, make("thead", {}, make("tr", {}, ...head.map(cells => make("th", { scope: "col" }, ...cells)))),
    make("tbody", {}, ...rows.map(cells => make("tr", {}, ...cells)))));

// A Markdown table; a word where there is none.
function table(markdown, missing, label) {
  if (!markdown) return make("p", { className: "quiet" }, missing);
  const rows = markdown.trim().split("\n").filter(line => !line.startsWith("|:"));
  const cells = line => line.slice(1, -1).split(/(?<!\\)\|/).map(cell => cell.trim().replaceAll("\\|", "|"));
  return grid(cells(rows[0]).map(title => hinted(title, title)),
    rows.slice(1).map(line => cells(line).map(cell => make("td", {}, cell))), label);
}

// The scores: two lines of head, the best of a column bold, the difference to the first row below a figure.
function scores() {
  if (!data.scores.length) return make("p", { className: "quiet" }, "No run has been trained to its end.");
  const head = [[""], ...data.scores.map(({ split, title }) => [split, make("br"), ...hinted(title, title)])];
  const rows = data.strategies.map(({ name, seeds, color }, i) => [
    make("td", {}, swatch(color), name, ...(seeds > 1 ? [make("small", {}, `${seeds} seeds`)] : [])),
    ...data.scores.map(({ cells }) => {
      const { text, best, delta, better, interval } = cells[i], word = better == null ? "" : better ? "better" : "worse";
      const arrow = word && (delta[0] === "+" ? "▲△" : "▼▽")[better ? 0 : 1];
      return make("td", {}, make(best ? "strong" : "span", {}, text),
        ...(interval ? [make("small", {}, interval)] : []),
        ...(delta ? [make("small", { className: word, title: word }, `${delta} ${arrow}`)] : []));
    })]);
  const legend = data.strategies.length < 2 ? "" : `Bold: the best of a column. Below: the difference to `
    + `${data.strategies[0].name}; a filled arrow is better, an empty one worse.`;
  return make("div", {}, grid(head, rows, "scores"), make("p", { className: "quiet" }, legend));
}
const bar = (what, low, high) => make("div", {}, make("b", {}, what),
  make("img", { src: data.legend, alt: "color bar from black over red to pale yellow" }),
  make("span", {}, low), make("span", {}, high));

$("scene").append(`${data.scene}: ${data.runs.map(run => run.label).join(", ")}`);
$("verdict").append(data.verdict);
$("evidence").append(...data.evidence.map(line => make("li", {}, line)));
$("evidence").append(...data.notes.map(line => make("li", { className: "quiet" }, line)));
$("made").append(data.made);
$("about").append(data.about.join("\n"));
$("scores").append(scores());
$("settings").append(table(data.settings, "All settings are the defaults.", "settings"));
$("attribution").append(table(data.attribution, "No run has a score to attribute.", "concentration"));
for (const [label, markdown] of Object.entries(data.perView))
  $("each").append(make("h3", {}, label), table(markdown, "", `views of ${label}`));
if (data.curves.length) addCharts();
else $("dynamics").append(make("p", { className: "quiet" }, "Nothing was measured while the runs were trained."));

// The views: two pictures upon each other, the right one shown to the right of the wipe, or both in turn.
const KINDS = { photograph: "photograph", render: "render", error: "error", "expected error": "expected error", "co-adaptation": "CA map" };
const stacks = [], nobody = ["render", "expected error"]; // what is shown where nobody took a photograph
const [first, ...more] = data.runs.length > 1 ? data.runs.keys() : [];
for (const [id, usual] of [["left", "photograph"], ["right", "render"]]) {
  $(id).append(...Object.entries(KINDS).map(([kind, name]) => make("option", { value: kind }, name)));
  for (const i of more.length ? [first, ...more] : [])
    $(id).append(...Object.entries(KINDS).slice(1).map(([kind, name]) =>
      make("option", { value: `${kind}/${i}` }, `${name} of ${data.runs[i].label}`)));
  $(id).value = data.views.some(view => view.photograph) ? usual : id === "left" ? "render" : "co-adaptation";
}
function stack(view, run, kinds) {
  const part = { view, run, kinds, box: make("button", { className: "stack", type: "button" }), turn: false };
  part.images = [0, 1].map(() => make("img", { style: `aspect-ratio: ${view.size.join(" / ")}` }));
  part.names = [0, 1].map(() => make("span", { ariaHidden: "true" }));
  part.box.append(...part.images, ...part.names);
  return part;
}
function refresh(part) {
  const { view, run, kinds, images, names, turn } = part, beside = kinds && part !== large;
  const flicker = $("flicker").checked && !beside, wipe = flicker ? (turn ? 0 : 100) : $("wipe").value;
  const found = ["left", "right"].map((id, side) => {
    const [kind, of] = (kinds?.[side] ?? $(id).value).split("/"), picture = { photograph: view.photograph, ...view.pictures[of ?? run] }[kind];
    const name = (of ? `${KINDS[kind]} of ${data.runs[of].label}` : KINDS[kind]) + (picture ? "" : ": none");
    if (picture && images[side].src !== picture) images[side].src = picture;
    images[side].hidden = !picture;
    names[side].textContent = name;
    images[side].alt = `${name}, ${view.name}, ${data.runs[run].label}`;
    return Boolean(picture);
  });
  const at = found[0] && found[1] && !beside ? wipe : 0;
  images[1].style.clipPath = `inset(0 0 0 ${at}%)`;
  names.forEach((name, side) => { name.hidden = flicker && side !== Number(turn); });
}
const refreshAll = () => {
  $("wide").value = $("wipe").value;
  stacks.forEach(refresh);
  if (large) refresh(large);
};
let large = null, flickering = 0;
for (const [view, kinds] of [...data.views.map(view => [view]), ...data.unseen.map(view => [view, nobody])]) {
  const figures = view.pictures.map((pictures, run) => {
    const part = stack(view, run, kinds), number = stacks.push(part) - 1;
    part.box.classList.toggle("pair", Boolean(kinds));
    part.caption = [data.runs[run].label, view.name, pictures.caption ?? "not among the views of this run"];
    part.box.onclick = () => enlarge(number);
    return make("figure", {}, part.box, make("figcaption", {}, swatch(data.runs[run].color), part.caption.filter(Boolean).join(" · ")));
  });
  $(kinds ? "worst" : "views").append(make("div", { className: "side" }, ...figures));
}
// Paper cannot be wiped: there the pictures of a view stand beside each other.
addEventListener("beforeprint", () => {
  document.querySelectorAll("details").forEach(part => { part.open = true; });
  for (const { view, run, kinds, box } of stacks) {
    const pictures = { photograph: view.photograph, ...view.pictures[run] };
    const shown = Object.keys(KINDS).filter(kind => pictures[kind] && !kinds).map(kind =>
      make("span", {}, make("img", { src: pictures[kind], alt: "" }), KINDS[kind]));
    if (shown.length) box.after(make("div", { className: "sheet" }, ...shown));
  }
});
addEventListener("afterprint", () => document.querySelectorAll(".sheet").forEach(sheet => sheet.remove()));
for (const id of ["left", "right", "wipe"]) $(id).oninput = refreshAll;
$("wide").oninput = () => { $("wipe").value = $("wide").value; refreshAll(); };
$("flicker").oninput = () => {
  clearInterval(flickering);
  if ($("flicker").checked) flickering = setInterval(() => {
    for (const part of large ? [...stacks, large] : stacks) part.turn = !part.turn;
    refreshAll();
  }, 700);
  refreshAll();
};
function enlarge(number) {
  const { view, run, kinds, caption, turn } = stacks[number = (number + stacks.length) % stacks.length];
  large = Object.assign(stack(view, run, kinds), { turn });
  large.box.onpointermove = event => {
    const { left, width } = large.box.getBoundingClientRect();
    $("wide").value = 100 * (event.clientX - left) / width;
    $("wide").oninput();
  };
  $("enlarged").replaceChildren(large.box);
  $("which").textContent = caption.filter(Boolean).join(" · ");
  $("large").style.setProperty("--aspect", view.size[0] / view.size[1]);
  $("earlier").onclick = () => enlarge(number - 1);
  $("later").onclick = () => enlarge(number + 1);
  refreshAll();
  if (!$("large").open) { $("large").showModal(); $("wide").focus(); }
}
$("large").onkeydown = ({ key }) => ({ PageUp: $("earlier"), PageDown: $("later") })[key]?.click();
$("large").onclose = () => { large = null; };
$("close").onclick = () => $("large").close();
refreshAll();
if (data.views.some(view => view.photograph)) $("ranges").append(bar("error and expected error (mean over the colors)", "0", `${data.ends.error} or more`));
if (data.unseen.length) $("ranges-unseen").append(bar("expected error (of colors in [0, 1], mean over them)", "0", `${data.ends.error} or more`));
else $("unseen").remove();
for (const { src, caption } of data.veils) $("veils").append(make("figure", {}, make("img", { src, alt: caption }), make("figcaption", {}, caption)));
if (data.attribution) $("ranges").append(bar("CA map (variance, half left out); gray does not count", "0", `${data.ends.ca} or more`));

// The models, and one camera for all of them.
const camera = {}, models = [];
let depth = 1, up = [0, 1, 0]; // of the point that is turned around; of the world
const row = i => camera.rotation.slice(3 * i, 3 * i + 3);

const place = pose => Object.assign(camera, { rotation: [0, 4, 8].flatMap(i => pose.slice(i, i + 3)),
  translation: [3, 7, 11].map(i => pose[i]) });

function lookFrom({ pose, focal, center, size }) {
  Object.assign(place(pose), { focal, center, size });
  $("stage").style.setProperty("--aspect", size[0] / size[1]);
  turnHere();
}

// What is in front of the camera is turned around from now on.
function turnHere() {
  up = row(1);
  const { geometry, run } = models[0], depths = new Float32Array(run.count);
  for (let i = 0; i < run.count; i++)
    depths[i] = dot(row(2), geometry.subarray(16 * i, 16 * i + 3)) + camera.translation[2];
  const ahead = depths.filter(z => z > 0.2).sort();
  depth = ahead.length ? ahead[ahead.length >> 1] : 1;
}

// Turns the world about an axis of the camera's frame, through the point that is turned around.
function turn(axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), [x, y, z] = axis;
  const turned = v => {
    const along = (1 - c) * dot(axis, v);
    return [c * v[0] + s * (y * v[2] - z * v[1]) + along * x, c * v[1] + s * (z * v[0] - x * v[2]) + along * y,
      c * v[2] + s * (x * v[1] - y * v[0]) + along * z];
  };
  const columns = [0, 1, 2].map(j => turned([0, 1, 2].map(i => camera.rotation[3 * i + j])));
  camera.rotation = [0, 1, 2].flatMap(i => columns.map(column => column[i]));
  const [tx, ty, tz] = camera.translation, t = turned([tx, ty, tz - depth]);
  camera.translation = [t[0], t[1], t[2] + depth];
}

function move(dx, dy, canvas) {
  const unit = camera.size[0] / canvas.clientWidth;
  camera.translation[0] += dx * unit * depth / camera.focal[0];
  camera.translation[1] += dy * unit * depth / camera.focal[1];
}
function spin(dx, dy) {
  turn([0, 1, 2].map(i => dot(row(i), up)), -dx / 200);
  turn([1, 0, 0], dy / 200);
}
function zoom(by) {
  const nearer = depth * Math.exp(by / 1000);
  camera.translation[2] += nearer - depth;
  depth = nearer;
}

function draw() {
  const hide = Number($("hide").value), heat = $("heat").checked;
  $("hidden").value = hide;
  for (const model of models) {
    model.draw(camera, heat, 1 - hide / 100);
    const { label, count, held, color } = model.run, gone = Math.floor(count * hide / 100);
    model.caption.replaceChildren(swatch(color), `${label} · ${count - gone} of ${count} Gaussians`
      + (hide && held.length ? `; those hidden hold ${(100 * held[hide]).toFixed(1)} % of the co-adaptation` : ""));
  }
}
let asked = 0;
const redraw = () => { asked ||= requestAnimationFrame(() => { asked = 0; draw(); }); };

async function showModels() {
  for (const run of data.runs) {
    const canvas = make("canvas", { tabIndex: 0, role: "img", ariaLabel: `the model ${run.label} in 3D` }), caption = make("figcaption", {});
    $("models").append(make("figure", {}, canvas, caption));
    models.push(Object.assign(new Model(canvas, run, await unpack(run.values, run.count)), { caption }));
    canvas.onpointerdown = event => canvas.setPointerCapture(event.pointerId);
    canvas.oncontextmenu = event => event.preventDefault();
    canvas.onpointermove = event => {
      if (!event.buttons) return;
      if (event.shiftKey || event.buttons > 1) move(event.movementX, event.movementY, canvas);
      else spin(event.movementX, event.movementY);
      redraw();
    };
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      zoom(event.deltaY);
      redraw();
    }, { passive: false });
    canvas.onkeydown = event => {
      const arrow = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] }[event.key];
      const nearer = { "+": -100, "=": -100, "-": 100 }[event.key];
      if (arrow) (event.shiftKey ? move : spin)(...arrow, canvas);
      else if (nearer) zoom(nearer);
      else return;
      event.preventDefault();
      redraw();
    };
  }
  const places = [...data.views, ...data.unseen];
  $("from").append(...places.map((view, i) => make("option", { value: i }, view.name)));
  $("from").onchange = () => { lookFrom(places[$("from").value]); redraw(); };
  $("reset").onclick = () => { stop(); $("hide").value = 0; $("from").onchange(); };
  $("full").onclick = () => document.fullscreenElement ? document.exitFullscreen() : $("stage").requestFullscreen();
  $("play").disabled = !data.flight.length;
  let playing = 0, frame = 0;
  const stop = () => {
    if (playing) turnHere();
    playing = clearInterval(playing) ?? 0;
    $("play").textContent = "play";
  };
  $("play").onclick = () => {
    if (playing) return stop();
    $("play").textContent = "pause";
    playing = setInterval(() => { // there and back
      const last = data.flight.length - 1, along = frame++ % (2 * last);
      place(data.flight[Math.min(along, 2 * last - along)]);
      redraw();
    }, 50);
  };
  $("models").addEventListener("pointerdown", stop);
  $("shot").onclick = () => {
    const { width, height } = models[0].canvas, all = make("canvas", { width: width * models.length, height: height + 24 });
    const pen = all.getContext("2d");
    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, all.width, all.height);
    Object.assign(pen, { fillStyle: "#000", font: "16px system-ui, sans-serif" });
    models.forEach(({ canvas, run }, i) => {
      pen.drawImage(canvas, i * width, 24);
      pen.fillText(run.label, i * width + 6, 17, width - 12);
    });
    make("a", { href: all.toDataURL(), download: `${data.scene}.png` }).click();
  };
  for (const id of ["color", "heat", "hide"]) $(id).oninput = redraw;
  if (!data.attribution) for (const id of ["heat", "hide"]) $(id).disabled = true;
  addEventListener("resize", redraw);
  lookFrom(data.views[0]);
  draw();
  if (data.attribution) $("legend").append(bar("heat: share of the co-adaptation per contribution, logarithmic around the mean of the first run",
    data.ends.heat[0], `${data.ends.heat[1]} or more`));
}
const ready = showModels().catch(error => $("models").append(make("p", { className: "quiet" }, error.message)));
