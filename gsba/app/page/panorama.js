"use strict";
// A panorama to look around in: drag or arrow keys turn, wheel or + and - zoom.

const VERTEX = `#version 300 es
in vec2 corner; out vec2 place;
void main() { place = corner; gl_Position = vec4(corner, 0.0, 1.0); }`;
// x to the right, y down, z forward, as bearings of gsba are.
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place; out vec4 color;
uniform sampler2D erp; uniform vec2 half_size; uniform vec2 turn;
void main() {
  vec3 ray = vec3(place.x * half_size.x, -place.y * half_size.y, 1.0);
  float c = cos(turn.y), s = sin(turn.y);
  ray = normalize(vec3(ray.x, c * ray.y - s * ray.z, s * ray.y + c * ray.z));
  float longitude = atan(ray.x, ray.z) + turn.x;
  color = texture(erp, vec2(longitude / 6.2831853 + 0.5, asin(ray.y) / 3.1415927 + 0.5));
}`;

// A canvas in a figure; `load(address)` shows another panorama, `message(text)` a line instead.
function panoramaView(label) {
  const canvas = make("canvas", { class: "panorama", tabindex: 0, role: "img", "aria-label": `${label}. Arrow keys turn, plus and minus zoom.` });
  const line = make("span", { role: "status" }), flat = make("img", { class: "flat", alt: label });
  const figure = make("figure", {}, canvas, make("figcaption", { class: "faint" }, line)), look = { yaw: 0, pitch: 0, fov: 1.6 };
  let scene = null, newest = 0;
  const draw = () => { if (scene) scene.draw(look); };
  const turn = (yaw, pitch) => {
    look.yaw += yaw;
    look.pitch = Math.min(1.5, Math.max(-1.5, look.pitch + pitch));
    draw();
  };
  const zoom = (factor) => { look.fov = Math.min(2.2, Math.max(0.4, look.fov * factor)); draw(); };
  let held = null;
  canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    const angle = look.fov / canvas.clientWidth;
    turn((held[0] - e.clientX) * angle, (e.clientY - held[1]) * angle);
    held = [e.clientX, e.clientY];
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { held = null; });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(e.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] }[e.key];
    if (turns) turn(...turns);
    else if (e.key === "+" || e.key === "-") zoom(e.key === "+" ? 0.85 : 1.18);
    else return;
    e.preventDefault();
  });
  new ResizeObserver(draw).observe(canvas);
  const message = (text) => { line.textContent = text; };
  // `turnable` is false for raw lenses, whose pictures are no panoramas.
  const load = async (address, turnable, done = "") => {
    const own = ++newest, image = new Image();
    message("Loading the picture …");
    image.src = address;
    try {
      await image.decode();
    } catch {
      if (own === newest) message("There is no picture.");
      return;
    }
    if (own !== newest) return;
    if (turnable && !scene) scene = sceneOn(canvas);
    const turned = turnable && scene !== null;
    canvas.hidden = !turned;
    if (turned) {
      flat.remove();
      scene.show(image);
    } else {
      flat.src = address;
      canvas.after(flat);
    }
    draw();
    canvas.dataset.shown = address;
    message(done);
  };
  return { figure, load, message, look };
}

// Drawing of a panorama by WebGL 2; null = the browser has none, the flat picture is shown.
function sceneOn(canvas) {
  const gl = canvas.getContext("webgl2", { preserveDrawingBuffer: true });
  if (!gl) return null;
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "corner");
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  const place = (name) => gl.getUniformLocation(program, name);
  return {
    show: (image) => gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image),
    draw: ({ yaw, pitch, fov }) => {
      const ratio = window.devicePixelRatio || 1;
      canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
      canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      gl.viewport(0, 0, canvas.width, canvas.height);
      const across = Math.tan(fov / 2);
      gl.uniform2f(place("half_size"), across, across * canvas.height / canvas.width);
      gl.uniform2f(place("turn"), yaw, pitch);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    },
  };
}
