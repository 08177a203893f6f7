// Draws Gaussians by WebGL2 by the rasterizer's equations (docs/method.md), but for the early stop: a full pixel goes on
// taking what little is left, at most 0.01 of its colour.
//
// Each Gaussian is a quad, drawn front to back into a float image that holds (S, W) = (sum w c, sum w), w = alpha T.
// The blend function (ONE_MINUS_DST_ALPHA, ONE) makes the weights: T in front of a pair is 1 - W, since the weights sum
// to what is no longer transmitted. W itself is added up, so it keeps its digits where it is small. A second pass
// divides: C = (S + lambda T bg) / (W + lambda T); lambda = 1 is alpha blending. In `smoe` that image is of near pairs
// only. Pixels in which its W is small are drawn anew, with all strong pairs. A third image holds their B, the sum of
// the tails' alpha T, which is added to lambda T, and W once more for the blend function.

const CONSTANTS = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
const float NEAR = 0.2;                 // view depth; nearer Gaussians are culled
const float LOW_PASS = 0.3;             // px^2 added to the projected covariance
const float FRUSTUM_MARGIN = 1.3;       // the Jacobian is taken at most this many tan(fov / 2) off the axis
const float COMPENSATION_FLOOR = 2.5e-5;
const float RADIUS_ROOT_FLOOR = 0.1;
const float TILE = 16.0;
const float ALPHA_MAX = 0.99;
const int ALPHA = 0, SMOE = 1, SMOE_EQ7 = 2;  // RULES: which pairs count
const float ALPHA_CUT = 1.0 / 255.0;    // alpha: fainter pairs do not count
const float STRONG_ALPHA = 1.0 / 2040.0;  // smoe: fainter pairs are tails
const float TAIL_ALPHA = 1.0 / 520200.0;  // smoe: fainter tails do not count
const float KERNEL_CUT = 1e-5;          // smoe_eq7: smaller kernels do not count
const float CORE_KERNEL = 0.011108996;  // G at 3 sigma, inside which no gate of the background cuts
const float CORE_ALPHA = 1.0 / 1020.0;   // smoe: there, fainter pairs are faint
const float GATE_SUM_CUT = 1e-30;       // below it no gate is open
`;

const VERTEX = CONSTANTS + `
uniform usampler2D gaussians;  // two texels each: see pack() in html.py
uniform usampler2D harmonics;  // their spherical harmonics from degree 1 on
uniform mat3 rotation;         // world to view
uniform vec3 translation;
uniform vec3 cameraCentre;     // world
uniform vec2 focal, principalPoint, size;  // pixels
uniform int degree;            // of the spherical harmonics
uniform int rule;
uniform bool wide;             // smoe: all strong pairs and tails are drawn; else near pairs
uniform bool antialiasing;
uniform float backgroundGate;  // lambda
in uint index;                 // of the Gaussian: the instances come front to back
flat out vec2 mean;
flat out vec3 conic, colour;   // conic: xx, xy, yy per px^2
flat out float opacity, leastAlpha;

uvec4 texel(usampler2D image, uint i) {
  uint width = uint(textureSize(image, 0).x);
  return texelFetch(image, ivec2(i % width, i / width), 0);
}

mat3 rotationOf(vec3 v) {  // of the unit quaternion (w, v) with w > 0
  float w = sqrt(max(0.0, 1.0 - dot(v, v)));
  vec3 d = 1.0 - 2.0 * (dot(v, v) - v * v);
  vec3 same = 2.0 * v.xxy * v.yzz, turn = 2.0 * w * v.zyx;  // xy xz yz; wz wy wx
  return mat3(d.x, same.x + turn.x, same.y - turn.y, same.x - turn.x, d.y, same.z + turn.z, same.y + turn.y,
              same.z - turn.z, d.z);
}

vec3 viewDependent(vec3 direction) {
  int texels = degree;  // texels of each Gaussian: 11, 26 and 47 bytes in texels of 16
  uint words[12];
  for (int i = 0; i < texels; i++) {
    uvec4 part = texel(harmonics, index * uint(texels) + uint(i));
    for (int j = 0; j < 4; j++) words[4 * i + j] = part[j];
  }
  float x = direction.x, y = direction.y, z = direction.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[15];
  basis[0] = -0.4886025119 * y, basis[1] = 0.4886025119 * z, basis[2] = -0.4886025119 * x;
  basis[3] = 1.0925484306 * x * y, basis[4] = -1.0925484306 * y * z;
  basis[5] = 0.3153915653 * (2.0 * zz - xx - yy), basis[6] = -1.0925484306 * x * z;
  basis[7] = 0.5462742153 * (xx - yy);
  basis[8] = -0.5900435899 * y * (3.0 * xx - yy), basis[9] = 2.8906114426 * x * y * z;
  basis[10] = -0.4570457995 * y * (4.0 * zz - xx - yy);
  basis[11] = 0.3731763326 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
  basis[12] = -0.4570457995 * x * (4.0 * zz - xx - yy), basis[13] = 1.4453057213 * z * (xx - yy);
  basis[14] = -0.5900435899 * x * (xx - 3.0 * yy);
  vec3 sum = vec3(0.0);
  for (int k = 0; k < degree * (degree + 2); k++) {
    for (int channel = 0; channel < 3; channel++) {
      int at = 3 * k + channel + 2;  // byte; the first two are the scale
      int value = int(words[at >> 2] << (24 - 8 * (at & 3))) >> 24;
      sum[channel] += basis[k] * float(value);
    }
  }
  return sum * unpackHalf2x16(words[0]).x / 127.0;
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, for those that are not drawn
  uvec4 first = texel(gaussians, 2u * index), second = texel(gaussians, 2u * index + 1u);
  vec3 position = uintBitsToFloat(first.xyz);
  vec3 view = rotation * position + translation;
  if (!(view.z > NEAR)) return;

  // The covariance on the image plane: L L^T with L = J W R S.
  vec2 half0 = unpackHalf2x16(first.w), half1 = unpackHalf2x16(second.x), half2 = unpackHalf2x16(second.w);
  vec3 scales = exp(vec3(half0.y, half1));
  vec3 turn = vec3(unpackSnorm2x16(second.y), unpackSnorm2x16(second.z).x) * 0.70710678;
  vec2 limit = FRUSTUM_MARGIN * size / (2.0 * focal);
  vec2 slope = clamp(view.xy / view.z, -limit, limit), f = focal / view.z;
  mat3 axes = rotation * rotationOf(turn);
  vec3 a = scales * (f.x * (transpose(axes)[0] - slope.x * transpose(axes)[2]));
  vec3 b = scales * (f.y * (transpose(axes)[1] - slope.y * transpose(axes)[2]));
  vec3 covariance = vec3(dot(a, a) + LOW_PASS, dot(a, b), dot(b, b) + LOW_PASS), minors = cross(a, b);
  float unfiltered = dot(minors, minors);
  float determinant = unfiltered + LOW_PASS * (covariance.x + covariance.z - LOW_PASS);
  if (!(determinant > 0.0)) return;
  conic = vec3(covariance.z, -covariance.y, covariance.x) / determinant;

  // How far pairs count.
  opacity = half0.x;
  if (antialiasing) opacity *= sqrt(max(COMPENSATION_FLOOR, unfiltered / determinant));
  leastAlpha = rule == ALPHA ? ALPHA_CUT : rule == SMOE ? STRONG_ALPHA :
               min(backgroundGate * ALPHA_CUT, opacity * CORE_KERNEL);
  if (rule == SMOE && !wide) leastAlpha = max(leastAlpha, min(ALPHA_CUT, max(CORE_ALPHA, opacity * CORE_KERNEL)));
  float faintest = wide ? TAIL_ALPHA : leastAlpha;
  float reach = faintest > 0.0 ? 2.0 * log(opacity / faintest) : 1e9;
  if (rule == SMOE_EQ7) reach = min(reach, -2.0 * log(KERNEL_CUT));
  if (!(opacity > 0.0) || !(reach > 0.0)) return;
  mean = focal * view.xy / view.z + principalPoint - 0.5;
  vec2 extent = sqrt(reach * covariance.xz) + 0.5;
  vec2 low = mean - extent, high = mean + extent;
  if (rule != SMOE_EQ7) {  // and inside the tiles of the 3-sigma square
    float middle = 0.5 * (covariance.x + covariance.z);
    float radius = ceil(3.0 * sqrt(middle + sqrt(max(RADIUS_ROOT_FLOOR, middle * middle - determinant))));
    low = max(low, TILE * floor((mean - radius) / TILE) - 0.5);
    high = min(high, TILE * floor((mean + radius + TILE - 1.0) / TILE) - 0.5);
    if (any(greaterThanEqual(low, high))) return;
  }

  colour = 0.5 + 0.28209479177 * vec3(unpackHalf2x16(second.z).y, half2);
  if (degree > 0) colour += viewDependent(normalize(position - cameraCentre));
  colour = max(colour, 0.0);
  vec2 corner = mix(low, high, vec2(gl_VertexID & 1, gl_VertexID >> 1));
  vec2 ndc = 2.0 * (corner + 0.5) / size - 1.0;
  gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
}`;

const FRAGMENT = CONSTANTS + `
uniform vec2 size;
uniform int rule;
uniform bool wide;
uniform float faintBelow;  // smoe: where near pairs have a larger W no others count
uniform sampler2D near;  // where wide: what the near pairs have drawn
flat in vec2 mean;
flat in vec3 conic, colour;
flat in float opacity, leastAlpha;
layout(location = 0) out vec4 pair;
layout(location = 1) out vec4 tail;

void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5 - mean;
  float power = -0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) - conic.y * d.x * d.y;
  if (power > 0.0) discard;
  if (wide && texelFetch(near, ivec2(gl_FragCoord.xy), 0).a >= faintBelow) discard;
  float kernel = exp(power), logit = opacity * kernel, alpha = min(logit, ALPHA_MAX);
  bool isStrong = alpha >= leastAlpha && (rule != SMOE_EQ7 || kernel >= KERNEL_CUT);
  if (!isStrong && (!wide || alpha < TAIL_ALPHA)) discard;
  pair = isStrong ? vec4(colour * alpha, alpha) : vec4(0.0);
  tail = isStrong ? vec4(0.0, 0.0, 0.0, alpha) : vec4(alpha, 0.0, 0.0, 0.0);
}`;

const CORNERS = CONSTANTS + `
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const DIVISION = CONSTANTS + `
uniform sampler2D sums, wideSums, tails;
uniform int rule;
uniform vec3 background;
uniform float backgroundGate, faintBelow;
out vec4 pixel;

void main() {
  vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
  bool isWide = rule == SMOE && sum.a < faintBelow;
  if (isWide) sum = texelFetch(wideSums, ivec2(gl_FragCoord.xy), 0);
  float weight = backgroundGate * max(0.0, 1.0 - sum.a);
  if (isWide) weight += texelFetch(tails, ivec2(gl_FragCoord.xy), 0).r;
  float denominator = sum.a + weight;
  vec3 blended = (sum.rgb + weight * background) / denominator;
  pixel = vec4(sum.a < GATE_SUM_CUT ? background : blended, 1.0);
}`;

const RULES = {alpha: 0, smoe: 1, smoe_eq7: 2};  // the shaders' numbers

class Renderer {
  // model: {count, degree, faintBelow, antialiasing, background: [3], gaussians, harmonics: Uint32Array}
  constructor(canvas, model) {
    const gl = canvas.getContext("webgl2", {alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true});
    if (!gl) throw new Error("this browser has no WebGL2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("this GPU cannot draw into float images");
    // Without it sums have 11 bits: gates that are small everywhere in a pixel are lost.
    this.exact = gl.getExtension("EXT_float_blend") !== null;
    this.gl = gl, this.canvas = canvas, this.model = model;
    this.splat = this.program(VERTEX, FRAGMENT), this.divide = this.program(CORNERS, DIVISION);
    this.gaussians = this.data(model.gaussians), this.harmonics = this.data(model.harmonics);
    this.order = gl.createBuffer(), this.count = 0;
    this.instances = gl.createVertexArray(), this.nothing = gl.createVertexArray();
    const index = gl.getAttribLocation(this.splat.program, "index");
    gl.bindVertexArray(this.instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    this.sums = gl.createTexture(), this.wideSums = gl.createTexture(), this.tails = gl.createTexture();
    this.frame = gl.createFramebuffer(), this.wideFrame = gl.createFramebuffer();
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text), gl.compileShader(shader), gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return {program, at: (name) => gl.getUniformLocation(program, name)};
  }

  // An integer image that holds the words, four a texel.
  data(words) {
    const gl = this.gl, width = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const height = Math.max(1, Math.ceil(words.length / 4 / width));
    if (height > width) throw new Error("the model has more Gaussians than this GPU's images hold");
    const padded = new Uint32Array(4 * width * height);
    padded.set(words);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, width, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    return texture;
  }

  // order: Uint32Array, the Gaussians to draw, front to back.
  setOrder(order) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.order);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, order, this.gl.DYNAMIC_DRAW);
    this.count = order.length;
  }

  // camera: {rotation [3][3], translation [3], fx, fy, cx, cy}, of an image of the canvas's size.
  // blend: {mode: a name of RULES, gate}
  draw(camera, blend) {
    const gl = this.gl, {width, height} = this.canvas;
    const rule = blend.mode === "smoe_eq7" && blend.gate === 1 ? RULES.alpha : RULES[blend.mode];
    const gate = rule === RULES.alpha ? 1 : blend.gate;
    gl.viewport(0, 0, width, height);
    gl.activeTexture(gl.TEXTURE0);
    if (this.width !== width || this.height !== height) {
      const format = this.exact ? gl.RGBA32F : gl.RGBA16F, type = this.exact ? gl.FLOAT : gl.HALF_FLOAT;
      for (const [frame, texture, place] of [[this.frame, this.sums, gl.COLOR_ATTACHMENT0],
                                             [this.wideFrame, this.wideSums, gl.COLOR_ATTACHMENT0],
                                             [this.wideFrame, this.tails, gl.COLOR_ATTACHMENT1]]) {
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, null);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, texture, 0);
      }
      this.width = width, this.height = height;
    }
    const splat = this.splat, {rotation: r, translation: t} = camera;
    gl.useProgram(splat.program);
    gl.activeTexture(gl.TEXTURE0), gl.bindTexture(gl.TEXTURE_2D, this.gaussians);
    gl.activeTexture(gl.TEXTURE1), gl.bindTexture(gl.TEXTURE_2D, this.harmonics);
    gl.uniform1i(splat.at("gaussians"), 0), gl.uniform1i(splat.at("harmonics"), 1);
    gl.uniformMatrix3fv(splat.at("rotation"), true, r.flat());
    gl.uniform3fv(splat.at("translation"), t);
    gl.uniform3fv(splat.at("cameraCentre"), [0, 1, 2].map((i) => -(r[0][i] * t[0] + r[1][i] * t[1] + r[2][i] * t[2])));
    gl.uniform2f(splat.at("focal"), camera.fx, camera.fy);
    gl.uniform2f(splat.at("principalPoint"), camera.cx, camera.cy);
    gl.uniform2f(splat.at("size"), width, height);
    gl.uniform1i(splat.at("degree"), this.model.degree);
    gl.uniform1i(splat.at("rule"), rule), gl.uniform1i(splat.at("antialiasing"), this.model.antialiasing);
    gl.uniform1f(splat.at("backgroundGate"), gate), gl.uniform1f(splat.at("faintBelow"), this.model.faintBelow);
    gl.enable(gl.BLEND), gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.bindVertexArray(this.instances);
    this.drawPairs(this.frame, [gl.COLOR_ATTACHMENT0, gl.NONE], null);
    if (rule === RULES.smoe) this.drawPairs(this.wideFrame, [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1], this.sums);

    gl.disable(gl.BLEND), gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.divide.program);
    gl.activeTexture(gl.TEXTURE0), gl.bindTexture(gl.TEXTURE_2D, this.sums);
    gl.activeTexture(gl.TEXTURE1), gl.bindTexture(gl.TEXTURE_2D, this.tails);
    gl.activeTexture(gl.TEXTURE2), gl.bindTexture(gl.TEXTURE_2D, this.wideSums);
    gl.uniform1i(this.divide.at("sums"), 0), gl.uniform1i(this.divide.at("tails"), 1);
    gl.uniform1i(this.divide.at("wideSums"), 2);
    gl.uniform1i(this.divide.at("rule"), rule);
    gl.uniform3fv(this.divide.at("background"), this.model.background);
    gl.uniform1f(this.divide.at("backgroundGate"), gate);
    gl.uniform1f(this.divide.at("faintBelow"), this.model.faintBelow);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draws all Gaussians into the attachments of a frame. near: what their near pairs have drawn, or null for these.
  drawPairs(frame, attachments, near) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.drawBuffers(attachments);
    gl.clearColor(0, 0, 0, 0), gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform1i(this.splat.at("wide"), near !== null), gl.uniform1i(this.splat.at("near"), 2);
    gl.activeTexture(gl.TEXTURE2), gl.bindTexture(gl.TEXTURE_2D, near);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
  }
}
