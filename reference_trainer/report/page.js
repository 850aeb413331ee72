const data = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const make = (tag, properties, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

// A Markdown table; a word where there is none.
function table(markdown, missing) {
  if (!markdown) return make("p", { className: "quiet" }, missing);
  const rows = markdown.trim().split("\n").filter(line => !line.startsWith("|:"));
  const cells = line => line.slice(1, -1).split(/(?<!\\)\|/).map(cell => cell.trim().replaceAll("\\|", "|"));
  return make("table", {}, ...rows.map((line, i) =>
    make("tr", {}, ...cells(line).map(cell => make(i ? "td" : "th", {}, cell)))));
}

$("about").append(data.about.join("\n"));
for (const note of data.notes) $("about").append(make("div", { className: "quiet" }, note));
$("scores").append(table(data.scores, "No run has been trained to its end."));
$("settings").append(table(data.settings, "All settings are the defaults."));
$("attribution").append(table(data.attribution, "No run has a score to attribute."));
for (const [label, markdown] of Object.entries(data.perView)) $("each").append(make("h3", {}, label), table(markdown));
$("dynamics").append(data.dynamics
  ? make("img", { src: data.dynamics, alt: "Co-adaptation and PSNR against the iteration" })
  : make("p", { className: "quiet" }, "Nothing was measured while the runs were trained."));

// The views: layers upon each other, each revealed from the left as the slider moves from the one below it.
const KINDS = ["photograph", "render", "error", "co-adaptation"], layers = [];
for (const view of data.views) {
  const figures = view.pictures.map((pictures, i) => {
    const found = { photograph: view.photograph, ...pictures }, present = KINDS.filter(kind => found[kind]);
    const images = present.map(kind => make("img", { src: found[kind], alt: `${kind} of ${view.name}` }));
    images.forEach((image, j) => layers.push({ image, at: j && KINDS.indexOf(present[j]) }));
    const caption = pictures.caption ?? "not among the views of this run";
    return make("figure", {}, make("div", { className: "stack" }, ...images),
      make("figcaption", {}, [data.runs[i].label, view.name, caption].filter(Boolean).join(" · ")));
  });
  $("views").append(make("div", { className: "side" }, ...figures));
}
$("kind").oninput = () => {
  for (const { image, at } of layers) {
    const part = at ? Math.min(1, Math.max(0, $("kind").value - at + 1)) : 1;
    image.style.clipPath = `inset(0 ${100 - 100 * part}% 0 0)`;
  }
};
$("kind").oninput();
$("ranges").append(make("span", { className: "quiet" }, `Black is 0; pale yellow is an error of ${data.ends.error} or a `
  + `variance of ${data.ends.ca} (exact, half of the Gaussians left out), or more; gray does not count for the score.`));

// The models, and one camera for all of them.
const camera = {}, models = [];
let depth = 1, up = [0, 1, 0]; // of the point that is turned around; of the world
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const row = i => camera.rotation.slice(3 * i, 3 * i + 3);

function lookFrom(view) {
  const { pose, focal, center, size } = view;
  Object.assign(camera, { focal, center, size, rotation: [0, 4, 8].flatMap(i => pose.slice(i, i + 3)),
    translation: [3, 7, 11].map(i => pose[i]) });
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

function draw() {
  const hide = Number($("hide").value), heat = $("heat").checked;
  $("hidden").value = hide;
  for (const model of models) {
    model.draw(camera, heat, 1 - hide / 100);
    const { label, count, held } = model.run, gone = Math.floor(count * hide / 100);
    model.caption.textContent = `${label} · ${count - gone} of ${count} Gaussians`
      + (hide && held.length ? `; those hidden hold ${(100 * held[hide]).toFixed(1)} % of the co-adaptation` : "");
  }
}
let asked = 0;
const redraw = () => { asked ||= requestAnimationFrame(() => { asked = 0; draw(); }); };

try {
  for (const run of data.runs) {
    const canvas = make("canvas", {}), caption = make("figcaption", {});
    $("models").append(make("figure", {}, canvas, caption));
    models.push(Object.assign(new Model(canvas, run), { caption }));
    canvas.onpointerdown = event => canvas.setPointerCapture(event.pointerId);
    canvas.oncontextmenu = event => event.preventDefault();
    canvas.onpointermove = event => {
      if (!event.buttons) return;
      const unit = camera.size[0] / canvas.clientWidth, dx = event.movementX, dy = event.movementY;
      if (event.shiftKey || event.buttons > 1) {
        camera.translation[0] += dx * unit * depth / camera.focal[0];
        camera.translation[1] += dy * unit * depth / camera.focal[1];
      } else {
        turn([0, 1, 2].map(i => dot(row(i), up)), -dx / 200);
        turn([1, 0, 0], dy / 200);
      }
      redraw();
    };
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      const nearer = depth * Math.exp(event.deltaY / 1000);
      camera.translation[2] += nearer - depth;
      depth = nearer;
      redraw();
    }, { passive: false });
  }
  $("from").append(...data.views.map((view, i) => make("option", { value: i }, view.name)));
  $("from").onchange = () => { lookFrom(data.views[$("from").value]); redraw(); };
  for (const id of ["color", "heat", "hide"]) $(id).oninput = redraw;
  if (!data.attribution) for (const id of ["heat", "hide"]) $(id).disabled = true;
  addEventListener("resize", redraw);
  lookFrom(data.views[0]);
  draw();
  $("legend").append(make("span", { className: "quiet" }, `Heat: share of the co-adaptation for what a Gaussian `
    + `contributes, ${data.ends.heat[0]} `, make("img", { src: data.legend, alt: "from black to pale yellow" }),
    ` ${data.ends.heat[1]} or more; logarithmic, one scale for all runs, a tenth to ten times the mean of the first.`));
} catch (error) {
  $("models").append(make("p", { className: "quiet" }, error.message));
}
