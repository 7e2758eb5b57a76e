// Draws a point cloud and hands with WebGL 2. Knows no service and no page beside its canvas.

const POINT_VERTEX = `#version 300 es
uniform mat4 clip_from_cloud;
uniform vec3 up;
uniform vec2 heights;
uniform float size;
in vec3 position;
out vec3 colour;
void main() {
  gl_Position = clip_from_cloud * vec4(position, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, 1.5, 12.0);
  float t = clamp((dot(position, up) - heights.x) / max(heights.y - heights.x, 1e-6), 0.0, 1.0);
  colour = mix(mix(vec3(0.20, 0.32, 0.60), vec3(0.25, 0.70, 0.68), min(1.0, 2.0 * t)), vec3(0.96, 0.90, 0.60), max(0.0, 2.0 * t - 1.0));
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 colour;
out vec4 pixel;
void main() {
  if (length(gl_PointCoord - 0.5) > 0.5) discard;
  pixel = vec4(colour, 1.0);
}`;

const SOLID_VERTEX = `#version 300 es
uniform mat4 clip_from_cloud;
in vec3 position;
in vec3 tint;
out vec3 place;
out vec3 colour;
void main() {
  place = position;
  colour = tint;
  gl_Position = clip_from_cloud * vec4(position, 1.0);
}`;

const SOLID_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 eye;
in vec3 place;
in vec3 colour;
out vec4 pixel;
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.45 + 0.55 * abs(dot(normal, normalize(eye - place)));
  pixel = vec4(colour * light, 1.0);
}`;

// Hands that were not chosen are drawn so much thinner.
const THIN = 0.2;

const plus = (a, b, s = 1) => a.map((value, axis) => value + s * b[axis]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true });
    this.works = this.gl !== null;
    this.grasps = [];
    this.chosen = 0;
    this.count = 0;
    this.up = [0, 0, 1];
    this.centre = [0, 0, 0];
    this.distance = 1;
    this.yaw = 0.6;
    this.pitch = 0.6;
    if (!this.works) return;
    this.pointProgram = program(this.gl, POINT_VERTEX, POINT_FRAGMENT);
    this.solidProgram = program(this.gl, SOLID_VERTEX, SOLID_FRAGMENT);
    this.pointBuffer = this.gl.createBuffer();
    this.solidBuffer = this.gl.createBuffer();
    this.solidVertices = 0;
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  // Shows points, seen from where the camera was: `viewpoint`, or the first of several.
  show(points, { viewpoint = [0, 0, 0], up = [0, -1, 0] }) {
    if (!this.works) return;
    this.up = unit(up);
    const eye = Array.isArray(viewpoint[0]) ? viewpoint[0] : viewpoint;
    const sample = [];
    for (let i = 0; i < points.length; i += 3 * Math.max(1, Math.floor(points.length / 3000))) sample.push([points[i], points[i + 1], points[i + 2]]);
    const median = (values) => values.sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? 0;
    this.centre = [0, 1, 2].map((axis) => median(sample.map((point) => point[axis])));
    const heights = sample.map((point) => dot(point, this.up)).sort((a, b) => a - b);
    this.heights = [heights[Math.floor(0.02 * heights.length)], heights[Math.floor(0.98 * heights.length)]];
    const radius = median(sample.map((point) => Math.hypot(...plus(point, this.centre, -1))));
    const offset = plus(eye, this.centre, -1);
    this.distance = Math.max(Math.min(Math.hypot(...offset), 6 * radius), 3 * radius, 0.05);
    const [a, b] = this.level();
    this.yaw = Math.atan2(dot(offset, b), dot(offset, a));
    this.pitch = Math.asin(Math.max(-0.99, Math.min(0.99, dot(unit(offset), this.up))));
    this.count = points.length / 3;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.pointBuffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, points, this.gl.STATIC_DRAW);
    this.showGrasps([], []);
  }

  // Shows hands made of `parts`, as the service describes them; a grasp also says where its TCP is.
  showGrasps(grasps, parts) {
    this.grasps = grasps;
    this.parts = parts;
    this.choose(0);
  }

  choose(index) {
    if (!this.works) return;
    this.chosen = index;
    const vertices = [];
    this.grasps.forEach((grasp, number) => hand(vertices, grasp, this.parts, number === index));
    this.solidVertices = vertices.length / 6;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.solidBuffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(vertices), this.gl.STATIC_DRAW);
    this.draw();
  }

  // Two unit vectors across `up`.
  level() {
    const a = unit(cross(Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], this.up));
    return [a, cross(this.up, a)];
  }

  draw() {
    const { gl, canvas } = this;
    const scale = window.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.043, 0.071, 0.125, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!this.count) return;
    gl.enable(gl.DEPTH_TEST);
    const [a, b] = this.level();
    const around = plus(a.map((value) => value * Math.cos(this.yaw)), b, Math.sin(this.yaw));
    const outward = plus(around.map((value) => value * Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
    const eye = plus(this.centre, outward, this.distance);
    const matrix = projected(eye, outward, this.up, canvas.width / canvas.height, this.distance);

    gl.useProgram(this.pointProgram);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.pointProgram, "clip_from_cloud"), false, matrix);
    gl.uniform3fv(gl.getUniformLocation(this.pointProgram, "up"), this.up);
    gl.uniform2fv(gl.getUniformLocation(this.pointProgram, "heights"), this.heights);
    gl.uniform1f(gl.getUniformLocation(this.pointProgram, "size"), 0.0025 * canvas.height);
    attribute(gl, this.pointProgram, "position", this.pointBuffer, 3, 0);
    gl.drawArrays(gl.POINTS, 0, this.count);

    gl.useProgram(this.solidProgram);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.solidProgram, "clip_from_cloud"), false, matrix);
    gl.uniform3fv(gl.getUniformLocation(this.solidProgram, "eye"), eye);
    attribute(gl, this.solidProgram, "position", this.solidBuffer, 6, 0);
    attribute(gl, this.solidProgram, "tint", this.solidBuffer, 6, 3);
    gl.drawArrays(gl.TRIANGLES, 0, this.solidVertices);
    this.right = unit(cross(this.up, outward));
    this.upward = cross(outward, this.right);
  }

  listen() {
    const { canvas } = this;
    const turn = (yaw, pitch) => {
      this.yaw -= yaw;
      this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + pitch));
      this.draw();
    };
    const zoom = (factor) => {
      this.distance *= factor;
      this.draw();
    };
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons || !this.count) return;
      if (event.shiftKey || event.buttons > 1) {
        const metres = this.distance / canvas.clientHeight;
        this.centre = plus(plus(this.centre, this.right, -event.movementX * metres), this.upward, event.movementY * metres);
        this.draw();
      } else turn(event.movementX / 150, event.movementY / 150);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(event.deltaY / 800));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
      "+": () => zoom(0.9), "-": () => zoom(1.1),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!(event.key in keys)) return;
      event.preventDefault();
      keys[event.key]();
    });
  }
}

// Appends the triangles of a hand, 6 numbers a vertex: x, y, z and its colour, red to green by score; the chosen one is bright.
// A part is drawn section by section. The palm is drawn as a bar between the fingers' backs with a wrist, or it would hide the scene.
function hand(vertices, { tcp, quaternion, score, width }, parts, chosen) {
  const [x, y, z] = axes(quaternion);
  const tint = chosen ? [1, 0.62, 0.1] : [0.75 - 0.5 * score, 0.25 + 0.4 * score, 0.3];
  const share = chosen ? 1 : THIN;
  const place = ([a, b, c]) => plus(plus(plus(tcp, x, a), y, b), z, c);
  // Between two rectangles, each a breadth along x, a beginning and an end along y, and a place along z.
  const solid = (front, back) => {
    const corners = [front, back].flatMap(({ breadth, low, high, z: at }) =>
      [[-breadth, low], [breadth, low], [-breadth, high], [breadth, high]].map(([across, along]) => place([across / 2, along, at])));
    for (const [a, b, c, d] of [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
      for (const i of [a, b, c, a, c, d]) vertices.push(...corners[i], ...tint);
  };
  const fingers = parts.filter((part) => part.side !== 0);
  for (const { side, sections } of fingers) {
    const outlines = sections.map((section) => {
      const inner = (side * width) / 2;
      return { breadth: share * section.breadth, low: inner, high: inner + side * share * section.thickness, z: section.z };
    });
    outlines.slice(1).forEach((outline, number) => solid(outlines[number], outline));
  }
  const root = fingers[0]?.sections.at(-1);
  for (const { sections } of parts.filter((part) => part.side === 0)) {
    const front = sections[0].z, back = sections.at(-1).z;
    const thick = share * root.thickness, reach = width / 2 + thick, breadth = share * root.breadth;
    const across = { breadth, low: -reach, high: reach }, wrist = { breadth, low: -thick / 2, high: thick / 2 };
    solid({ ...across, z: front }, { ...across, z: front - thick / 2 });
    solid({ ...wrist, z: front - thick / 2 }, { ...wrist, z: back });
  }
}

// The columns of a quaternion's rotation matrix.
function axes([x, y, z, w]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
  ];
}

// Column-major clip-from-cloud matrix of a camera at `eye` that looks against `outward`.
function projected(eye, outward, up, aspect, distance) {
  const right = unit(cross(up, outward)), upward = cross(outward, right);
  const near = distance / 50, far = distance * 50, focal = 1 / Math.tan(0.4);
  const rows = [
    [...right.map((value) => (value * focal) / aspect), (-dot(right, eye) * focal) / aspect],
    [...upward.map((value) => value * focal), -dot(upward, eye) * focal],
  ];
  const depth = (far + near) / (near - far), shift = (2 * far * near) / (near - far);
  rows.push([...outward.map((value) => value * depth), -dot(outward, eye) * depth + shift]);
  rows.push([...outward.map((value) => -value), dot(outward, eye)]);
  return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

function attribute(gl, program, name, buffer, stride, offset) {
  const place = gl.getAttribLocation(program, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 4 * stride, 4 * offset);
}
