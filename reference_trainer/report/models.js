const data = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const make = (tag, properties, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};
const swatch = color => make("i", { className: "swatch", style: `background: ${color}` });
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// A model in WebGL 2: its Gaussians projected to ellipses, sorted by depth and blended back to front, with the formulas
// and constants of the reference renderer. Lengths are pixels of the training pictures, whatever the canvas has.
const ROW = 64; // Gaussians per row of a texture

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D geometry, colors;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec2 focal, center, size;
uniform float shown;
uniform int degree;
uniform bool heat;
in uint index;
out vec2 place;
flat out vec4 shade;

vec3 harmonics(int at, int row, vec3 d) {
  #define C(k) texelFetch(colors, ivec2(at + k, row), 0).rgb
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 c = 0.5 + 0.2820948 * C(0);
  if (degree > 0) c += 0.4886025 * (z * C(2) - y * C(1) - x * C(3));
  if (degree > 1) c += 1.0925484 * (x * y * C(4) - y * z * C(5) - x * z * C(7))
    + 0.3153916 * (2.0 * zz - xx - yy) * C(6) + 0.5462742 * (xx - yy) * C(8);
  if (degree > 2) c += 2.8906114 * x * y * z * C(10) + 1.4453057 * z * (xx - yy) * C(14)
    - 0.5900436 * (y * (3.0 * xx - yy) * C(9) + x * (xx - 3.0 * yy) * C(15))
    - 0.4570458 * (4.0 * zz - xx - yy) * (y * C(11) + x * C(13))
    + 0.3731763 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * C(12);
  return max(c, 0.0);
}

void main() {
  int row = int(index) / ${ROW}, column = int(index) % ${ROW};
  vec4 a = texelFetch(geometry, ivec2(4 * column, row), 0), b = texelFetch(geometry, ivec2(4 * column + 1, row), 0);
  vec4 c = texelFetch(geometry, ivec2(4 * column + 2, row), 0);
  vec3 p = rotation * a.xyz + translation;
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside of the picture
  if (p.z < 0.2 || c.z >= shown || a.w * 255.0 <= 1.0) return;
  mat3 covariance = mat3(b.xyz, b.y, b.w, c.x, b.z, c.x, c.y), axes = transpose(rotation);
  vec2 slope = p.xy / p.z, edge = 0.65 * size / focal, held = clamp(slope, -edge, edge);
  vec3 across = focal.x / p.z * (axes[0] - held.x * axes[2]), down = focal.y / p.z * (axes[1] - held.y * axes[2]);
  float xx = dot(across, covariance * across) + 0.3, xy = dot(across, covariance * down);
  float first = sqrt(xx), second = xy / first;
  float third = sqrt(max(dot(down, covariance * down) + 0.3 - second * second, 1e-6));
  place = (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0) * sqrt(2.0 * log(255.0 * a.w));
  vec2 at = focal * slope + center + vec2(first * place.x, second * place.x + third * place.y);
  gl_Position = vec4((2.0 * at / size - 1.0) * vec2(1.0, -1.0), 0.0, 1.0);
  int bands = (degree + 1) * (degree + 1);
  vec3 seen = normalize(a.xyz + axes * translation);
  shade = vec4(heat ? texelFetch(geometry, ivec2(4 * column + 3, row), 0).rgb
    : harmonics(bands * column, row, seen), a.w);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 shade;
out vec4 color;
void main() {
  float alpha = min(0.99, shade.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  color = vec4(shade.rgb * alpha, alpha);
}`;

// The numbers of a model, row by row: multiples of a step in 16 bits, stored as planes of bytes and compressed.
async function unpack({ text, steps }, count) {
  if (!self.DecompressionStream) throw new Error("This browser is too old for the models, which are compressed.");
  const packed = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer()), width = steps.length;
  const values = new Float32Array(count * width);
  steps.forEach((step, j) => {
    for (let i = 0; i < count; i++) {
      const at = 2 * j * count + i, coded = planes[at] | planes[at + count] << 8;
      values[i * width + j] = step * (coded >> 1 ^ -(coded & 1));
    }
  });
  return values;
}

// Per Gaussian: position, opacity, covariance (xx, xy, xz, yy, yz, zz), rank by heat in [0, 1), 0, color of the heat, 0.
function geometryOf(values, width, { count, center, scale }) {
  const geometry = new Float32Array(16 * count);
  for (let i = 0; i < count; i++) {
    const v = values.subarray(width * i, width * i + 14), at = 16 * i, m = [];
    for (let k = 0; k < 3; k++) geometry[at + k] = center[k] + scale * Math.sign(v[k]) * Math.expm1(Math.abs(v[k]));
    const [sx, sy, sz] = [v[3], v[4], v[5]].map(Math.exp), norm = Math.hypot(v[6], v[7], v[8], v[9]);
    const [w, x, y, z] = [v[6], v[7], v[8], v[9]].map(part => part / norm);
    m.push([sx * (1 - 2 * (y * y + z * z)), sy * 2 * (x * y - w * z), sz * 2 * (x * z + w * y)],
      [sx * 2 * (x * y + w * z), sy * (1 - 2 * (x * x + z * z)), sz * 2 * (y * z - w * x)],
      [sx * 2 * (x * z - w * y), sy * 2 * (y * z + w * x), sz * (1 - 2 * (x * x + y * y))]);
    geometry[at + 3] = v[10];
    [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]].forEach(([r, c], k) => { geometry[at + 4 + k] = dot(m[r], m[c]); });
    geometry[at + 10] = i / count;
    for (let k = 0; k < 3; k++) geometry[at + 12 + k] = v[11 + k];
  }
  return geometry;
}

class Model {
  constructor(canvas, run, values) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2, which the models need.");
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const height = Math.ceil(run.count / ROW), bands = (run.degree + 1) ** 2, width = run.values.steps.length;
    this.geometry = geometryOf(values, width, run);
    const colors = new Float32Array(3 * bands * run.count);
    for (let i = 0; i < run.count; i++) colors.set(values.subarray(width * i + 14, width * (i + 1)), 3 * bands * i);
    const most = ROW * gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (run.count > most) throw new Error(`${run.label} has ${run.count} Gaussians; this browser draws up to ${most}.`);
    const texture = (unit, name, kind, format, type, width, values) => {
      const whole = new values.constructor(width * height * (format === gl.RGB ? 3 : 4));
      whole.set(values);
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texImage2D(gl.TEXTURE_2D, 0, kind, width, height, 0, format, type, whole);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
    };
    texture(0, "geometry", gl.RGBA32F, gl.RGBA, gl.FLOAT, 4 * ROW, this.geometry);
    texture(1, "colors", gl.RGB16F, gl.RGB, gl.FLOAT, bands * ROW, colors);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const index = gl.getAttribLocation(program, "index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...run.background, 1);
    gl.uniform1i(gl.getUniformLocation(program, "degree"), run.degree);
    Object.assign(this, { canvas, run, gl, uniform: name => gl.getUniformLocation(program, name) });
  }

  // Indices from the farthest to the nearest, by a counting sort of the logarithm of the depth in 16 bits.
  order(camera) {
    const { geometry, run: { count } } = this, [x, y, z] = camera.rotation.slice(6), away = camera.translation[2];
    const keys = new Float32Array(count), starts = new Uint32Array(65537), sorted = new Uint32Array(count);
    for (let i = 0; i < count; i++) {
      const depth = x * geometry[16 * i] + y * geometry[16 * i + 1] + z * geometry[16 * i + 2] + away;
      keys[i] = Math.log(Math.max(depth, 0.2));
    }
    const low = Math.log(0.2), high = keys.reduce((a, b) => Math.max(a, b), low);
    for (let i = 0; i < count; i++) {
      keys[i] = Math.floor((high - keys[i]) / (high - low || 1) * 65535);
      starts[keys[i] + 1]++;
    }
    for (let i = 0; i < 65536; i++) starts[i + 1] += starts[i];
    for (let i = 0; i < count; i++) sorted[starts[keys[i]]++] = i;
    return sorted;
  }

  // camera: rotation (9 numbers by rows), translation, focal, center, size; shown: ranks below it are drawn.
  draw(camera, heat, shown) {
    const { canvas, gl, uniform } = this, [width, height] = camera.size;
    canvas.width = Math.round(canvas.clientWidth * devicePixelRatio);
    canvas.height = Math.round(canvas.width * height / width);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(uniform("rotation"), true, camera.rotation);
    gl.uniform3fv(uniform("translation"), camera.translation);
    for (const name of ["focal", "center", "size"]) gl.uniform2fv(uniform(name), camera[name]);
    gl.uniform1f(uniform("shown"), shown);
    gl.uniform1i(uniform("heat"), heat);
    gl.bufferData(gl.ARRAY_BUFFER, this.order(camera), gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.run.count);
  }
}
