// The WebAssembly module: renders, differentiates and trains with the kernels of the Python package. No DOM, so that it runs in a
// page, in a worker and in node.

import {
  ALPHA_MAX,
  DENSIFY_EVERY,
  DILATION,
  FAST_DENSIFICATIONS,
  LEAST_PLANNED,
  MILESTONES,
  PLANNED,
  PLANNED_PIXELS,
  PLANNED_VIEWS,
  RECIPE,
  RECIPE_ITERATIONS,
  SEPARATE,
  Z_NEAR,
} from "./recipe.js";

const PAGE = 1 << 16; // bytes
const FIRST_PAGES = 64;
const MOST_PAGES = 65535;
const WORKER_STACK = 1 << 20; // bytes
export const DEFAULT_LIMIT = 2 ** 31; // bytes of memory

export const PROJECTIONS = ["perspective", "fisheye", "equirectangular", "orthographic", "pinhole"];
export const PARAMETERS = ["means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities"];

// The addresses of a render's arrays, in the module's order: inputs, images, gradients of a loss in them, its gradients in the inputs.
const ARRAYS = [
  ...PARAMETERS,
  "features",
  "image",
  "transmittance",
  "depth",
  "median_depth",
  "mixed",
  "grad_image",
  "grad_transmittance",
  "grad_depth",
  "grad_mixed",
  ...PARAMETERS.map((name) => `grad_${name}`),
  "grad_features",
  "means2d_norm",
  "grad_background",
  "grad_camera",
];
// The C library could write a line before it aborts; there is no file to write to.
const BAD_FILE = 8;
const NO_FILES = { fd_close: () => BAD_FILE, fd_seek: () => BAD_FILE, fd_write: () => BAD_FILE };

const CAMERA_NUMBERS = 51;
const GRADIENT_NUMBERS = { pinhole: 16, lens: 37 };

// What the module, or this file, cannot do with what it was given. The message is for people.
export class EngineError extends Error {
  constructor(message) {
    super(message);
    this.name = "EngineError";
  }
}

/**
 * Loads the module.
 * @param {BufferSource | WebAssembly.Module | URL | string} source Its bytes, or where they are: gsplat_edu.wasm, or
 *   gsplat_edu_threads.wasm for several threads.
 * @param {{ limit?: number, threads?: number, startWorker?: (url: URL) => Worker }} options Bytes of memory that it may take, at most
 *   4 GiB; threads, more than one only where memory may be shared (in a page: if it is cross-origin isolated); and how a worker is
 *   started, for hosts without `Worker`.
 */
export async function loadModule(source, { limit = DEFAULT_LIMIT, threads = 1, startWorker = browserWorker } = {}) {
  const compiled = await compile(source);
  const shared = WebAssembly.Module.exports(compiled).some(({ name }) => name === "work");
  if (threads > 1 && !shared) throw new EngineError("this module is for one thread; load gsplat_edu_threads.wasm");
  if (shared && typeof SharedArrayBuffer === "undefined")
    throw new EngineError("this page may not share memory between threads; load gsplat_edu.wasm");
  const most = Math.max(Math.min(Math.floor(limit / PAGE), MOST_PAGES), FIRST_PAGES);
  const memory = new WebAssembly.Memory({ initial: FIRST_PAGES, maximum: most, shared });
  const { exports } = await WebAssembly.instantiate(compiled, importsOf(memory));
  exports._initialize();
  const module = new Module(exports, memory, threads);
  if (threads > 1) await module.startWorkers(compiled, startWorker);
  return module;
}

/** What an instance of the module needs from its host. */
export function importsOf(memory) {
  const host = {
    refuse: (address, length) => {
      throw new EngineError(new TextDecoder().decode(new Uint8Array(memory.buffer, address, length).slice()));
    },
    now: () => performance.now(),
  };
  return { env: { memory }, host, wasi_snapshot_preview1: NO_FILES };
}

function browserWorker(url) {
  return new Worker(url, { type: "module" });
}

async function compile(source) {
  if (source instanceof WebAssembly.Module) return source;
  if (source instanceof ArrayBuffer || ArrayBuffer.isView(source)) return WebAssembly.compile(source);
  const response = await fetch(source);
  if (!response.ok) throw new EngineError(`${source} cannot be read: ${response.status} ${response.statusText}`);
  return WebAssembly.compile(await response.arrayBuffer());
}

class Module {
  constructor(exports, memory, threads) {
    this.calls = exports;
    this.memory = memory;
    this.threads = threads;
    this.workers = [];
  }

  // Starts a worker for each thread but this one; all have this memory, and their own stacks and thread-local variables.
  async startWorkers(compiled, startWorker) {
    const { calls, memory } = this;
    const url = new URL("./engine_worker.js", import.meta.url);
    const ready = [];
    for (let id = 1; id < this.threads; ++id) {
      const stack = (calls.allocate(WORKER_STACK) >>> 0) + WORKER_STACK;
      const locals = calls.allocate(calls.__tls_size.value + calls.__tls_align.value) >>> 0;
      const worker = startWorker(url);
      this.workers.push(worker);
      ready.push(
        new Promise((resolve, reject) => {
          worker.onmessage = resolve;
          worker.onerror = () => reject(new EngineError("a thread of the module could not be started"));
        }),
      );
      worker.postMessage({ compiled, memory, id, stack, locals });
    }
    await Promise.all(ready);
  }

  /** Ends the workers; the module is not used afterwards. */
  close() {
    for (const worker of this.workers) worker.terminate();
    this.workers = [];
  }

  // Bytes that the module has taken from the system.
  get bytes() {
    return this.memory.buffer.byteLength;
  }

  // An array in the module's memory. Its address stays; the view ends when the memory grows.
  room(Type, length) {
    const address = this.calls.allocate(Math.max(length, 1) * Type.BYTES_PER_ELEMENT) >>> 0;
    return { address, view: () => new Type(this.memory.buffer, address, length) };
  }

  given(Type, values) {
    const room = this.room(Type, values.length);
    room.view().set(values);
    return room;
  }

  // Calls a function with a way to get memory that is released afterwards.
  withRoom(work) {
    const taken = [];
    const keep = (room) => {
      taken.push(room);
      return room;
    };
    try {
      return work({
        room: (Type, length) => keep(this.room(Type, length)),
        given: (Type, values) => keep(this.given(Type, values)),
      });
    } finally {
      for (const room of taken) this.calls.release(room.address);
    }
  }
}

/**
 * The numbers of a camera for the module.
 * @param camera { R (9, row by row, world to camera, OpenCV's axes), eye (3), fx, fy, cx, cy, W, H }, pixel centres at whole numbers;
 *   with a lens also { projection, distortion (15), radialFirst, motion (6), moving, axis, pace, widest, exposure, bounds }.
 */
export function cameraNumbers(camera, jacobianLimit = null) {
  const { R, eye, fx, fy, cx, cy, W, H, projection = "pinhole" } = camera;
  const kind = PROJECTIONS.indexOf(projection);
  if (R?.length !== 9 || eye?.length !== 3)
    throw new EngineError("a camera needs a rotation of 9 numbers and a place of 3");
  if (kind < 0) throw new EngineError(`the projection ${projection} is unknown; there are ${PROJECTIONS.join(", ")}`);
  const bounds = camera.bounds ?? [...bound(W, cx, fx, jacobianLimit), ...bound(H, cy, fy, jacobianLimit)];
  const distortion = camera.distortion ?? new Array(15).fill(0);
  const numbers = [
    ...R,
    ...eye,
    fx,
    fy,
    cx,
    cy,
    W,
    H,
    ...bounds,
    kind,
    camera.distortion ? 1 : 0,
    camera.radialFirst ? 1 : 0,
  ];
  numbers.push(camera.moving ? 1 : 0, camera.axis ?? 0, camera.pace ?? 0, camera.widest ?? 0, camera.exposure ?? 0);
  numbers.push(...distortion, ...(camera.motion ?? new Array(6).fill(0)));
  if (numbers.length !== CAMERA_NUMBERS)
    throw new EngineError("a lens needs 15 coefficients and 6 numbers of its motion");
  return Float64Array.from(numbers);
}

// Bounds of x/z for the Jacobian of a pinhole, `limit` times as far from the image's centre as its edge.
function bound(size, middle, focal, limit) {
  if (limit === null) return [-Infinity, Infinity];
  return [-limit, limit].map((side) => (0.5 * (size - 1) + 0.5 * side * size - middle) / focal);
}

function settingNumbers(settings = {}) {
  const {
    zNear = Z_NEAR,
    background = [0, 0, 0],
    shDegree = 3,
    antialiased = false,
    dilation = DILATION,
    alphaMax = ALPHA_MAX,
  } = settings;
  return Float64Array.from([
    zNear,
    ...background,
    shDegree,
    antialiased ? 1 : 0,
    dilation,
    alphaMax,
    settings.pixelStop ? 1 : 0,
  ]);
}

/**
 * Renders Gaussians; with `upstream`, also differentiates sum(upstream * images).
 * @param module From loadModule.
 * @param gaussians { means (3 N), quats (4 N), log_scales (3 N), sh0 (3 N), sh_rest (3 K N), logit_opacities (N), features? }, Float32Array
 *   or Float64Array, all of one kind, which is also that of the arithmetic.
 * @param camera See cameraNumbers.
 * @param settings { background, shDegree, antialiased, jacobianLimit, dilation, alphaMax, zNear, pixelStop }.
 * @param upstream { image, transmittance?, depth?, features? } Gradients of a loss in the images.
 * @returns { image, transmittance, depth, median_depth, features?, gradients? }.
 */
export function render(module, gaussians, camera, settings = {}, upstream = null) {
  const Type = gaussians.means.constructor;
  const suffix = Type === Float64Array ? "f64" : "f32";
  if (Type !== Float64Array && Type !== Float32Array)
    throw new EngineError("means have to be a Float32Array or a Float64Array");
  const count = gaussians.logit_opacities.length;
  const rest = count ? gaussians.sh_rest.length / (3 * count) : (settings.rest ?? 0);
  const channels = gaussians.features && count ? gaussians.features.length / count : 0;
  const widths = { means: 3, quats: 4, log_scales: 3, sh0: 3, sh_rest: 3 * rest, logit_opacities: 1 };
  for (const [name, width] of Object.entries(widths)) {
    if (!(gaussians[name] instanceof Type) || gaussians[name].length !== width * count) {
      throw new EngineError(
        `${name}: has to have ${width} numbers for each of ${count} splats, of the same kind as means`,
      );
    }
  }
  const pixels = camera.W * camera.H;
  const calls = module.calls;
  return module.withRoom(({ room, given }) => {
    const rooms = { image: room(Type, 3 * pixels), transmittance: room(Type, pixels) };
    rooms.depth = room(Type, pixels);
    rooms.median_depth = room(Type, pixels);
    for (const name of PARAMETERS) rooms[name] = given(Type, gaussians[name]);
    if (channels) {
      rooms.features = given(Type, gaussians.features);
      rooms.mixed = room(Type, channels * pixels);
    }
    const numbers =
      camera.projection && camera.projection !== "pinhole" ? GRADIENT_NUMBERS.lens : GRADIENT_NUMBERS.pinhole;
    if (upstream) {
      for (const [name, width] of Object.entries(widths)) rooms[`grad_${name}`] = room(Type, width * count);
      rooms.grad_image = given(Type, upstream.image ?? new Type(3 * pixels));
      for (const name of ["transmittance", "depth"])
        if (upstream[name]) rooms[`grad_${name}`] = given(Type, upstream[name]);
      if (channels && upstream.features) {
        rooms.grad_mixed = given(Type, upstream.features);
        rooms.grad_features = room(Type, channels * count);
      }
      rooms.means2d_norm = room(Type, count);
      rooms.grad_background = room(Type, 3);
      rooms.grad_camera = room(Float64Array, numbers);
    }
    const addresses = given(
      Uint32Array,
      ARRAYS.map((name) => rooms[name]?.address ?? 0),
    ).address;
    const cameraAddress = given(Float64Array, cameraNumbers(camera, settings.jacobianLimit ?? null)).address;
    const settingAddress = given(Float64Array, settingNumbers(settings)).address;
    const drawn = calls[`draw_${suffix}`](
      count,
      rest,
      channels,
      addresses,
      cameraAddress,
      settingAddress,
      module.threads,
    );
    try {
      if (upstream) calls[`differentiate_${suffix}`](drawn, addresses);
    } finally {
      calls[`forget_${suffix}`](drawn);
    }
    const copy = (name) => rooms[name].view().slice();
    const out = { image: copy("image"), transmittance: copy("transmittance") };
    Object.assign(out, { depth: copy("depth"), median_depth: copy("median_depth") });
    if (channels) out.features = copy("mixed");
    if (upstream) {
      const names = [...PARAMETERS, ...(rooms.grad_features ? ["features"] : []), "background", "camera"];
      out.gradients = Object.fromEntries(names.map((name) => [name, copy(`grad_${name}`)]));
    }
    return out;
  });
}

// Rounds halves to even, as Python does.
function roundEven(x) {
  const below = Math.floor(x);
  if (x - below !== 0.5) return Math.round(x);
  return below % 2 === 0 ? below : below + 1;
}

/**
 * The settings of the recipe fast for a run of any length, as `gsplat_edu.train.config.recipe` makes them.
 * @param iterations Steps of the run.
 * @param changes Settings by the names of RECIPE; they are not scaled.
 */
export function recipe(iterations, changes = {}) {
  if (!Number.isInteger(iterations) || iterations < 1)
    throw new EngineError("iterations have to be a whole number of at least 1");
  const unknown = Object.keys(changes).find((name) => !(name in RECIPE));
  if (unknown) throw new EngineError(`the setting ${unknown} is unknown`);
  const scaled = Object.fromEntries(
    MILESTONES.map((name) => [name, Math.max(1, roundEven((RECIPE[name] * iterations) / RECIPE_ITERATIONS))]),
  );
  scaled.densify_every = Math.min(Math.max(Math.floor(iterations / FAST_DENSIFICATIONS), 1), DENSIFY_EVERY);
  return { ...RECIPE, iterations, ...scaled, ...changes };
}

/**
 * How many Gaussians the recipe grows to, as `gsplat_edu.train.capacity.planned_gaussians`.
 * @param pixels Mean pixels of a training view.
 * @param views Number of training views.
 * @param separate As many views as show nothing in common.
 */
export function plannedGaussians(pixels, views, separate = 1) {
  const share = Math.cbrt(pixels / PLANNED_PIXELS) * Math.sqrt(views / PLANNED_VIEWS);
  const more = Math.sqrt(Math.max(1, separate / SEPARATE));
  return Math.max(roundEven(Math.min(PLANNED * share, pixels) * more), LEAST_PLANNED);
}

/**
 * The size of a scene by the spread of its cameras, as `gsplat_edu.scene.rig.scene_extent` without strays.
 * @param cameras At least one.
 */
export function sceneExtent(cameras) {
  const mean = [0, 1, 2].map((c) => cameras.reduce((sum, camera) => sum + camera.eye[c], 0) / cameras.length);
  const spread = Math.max(...cameras.map(({ eye }) => Math.hypot(...eye.map((value, c) => value - mean[c]))));
  const size = Math.max(...cameras.map(({ eye }) => Math.hypot(...eye)));
  return spread > 1e-9 * size ? 1.1 * spread : 1;
}

/** A training in the module's memory. */
export class Trainer {
  /**
   * @param module From loadModule.
   * @param options { points (3 N), colors (3 N, 0 to 1), views: [{ name, camera, pixels (3 H W bytes) }], extent?, settings: { iterations,
   *   maxGaussians?, shDegree?, seed?, background? } }.
   */
  constructor(module, { points, colors, views, extent = null, settings }) {
    if (!views?.length) throw new EngineError("there is no photo to learn from");
    if (points.length !== colors.length || points.length % 3)
      throw new EngineError("points and colours have to be 3 numbers each, and as many");
    const cameras = views.map((view) => view.camera);
    const pixels = cameras.reduce((sum, { W, H }) => sum + W * H, 0) / cameras.length;
    const planned = settings.maxGaussians ?? Math.max(plannedGaussians(pixels, views.length), 1);
    const chosen = { max_gaussians: planned };
    if (settings.shDegree !== undefined) chosen.sh_degree = settings.shDegree;
    if (settings.seed !== undefined) chosen.seed = settings.seed;
    this.module = module;
    this.planned = planned;
    this.recipe = recipe(settings.iterations, chosen);
    const background = settings.background ?? [0, 0, 0];
    const names = Object.keys(RECIPE);
    this.handle = module.withRoom(({ given }) =>
      module.calls.train(
        given(Float64Array, [...names.map((name) => this.recipe[name]), ...background]).address,
        extent ?? sceneExtent(cameras),
        given(Float64Array, points).address,
        given(Float64Array, colors).address,
        points.length / 3,
        module.threads,
      ),
    );
    for (const view of views) this.addView(view);
  }

  addView({ name, camera, pixels }) {
    if (pixels.length !== 3 * camera.W * camera.H)
      throw new EngineError(`${name}: has another number of pixels than its camera`);
    this.withPhoto(camera, pixels, (numbers, photo) => this.module.calls.add_view(this.handle, numbers, photo));
  }

  withPhoto(camera, pixels, work) {
    return this.module.withRoom(({ given }) =>
      work(given(Float64Array, cameraNumbers(camera)).address, given(Uint8Array, pixels).address, given),
    );
  }

  /** Takes steps, at most to the end of the run; returns { iteration, count, loss } after the last of them. */
  step(count = 1) {
    let loss = Number.NaN;
    for (let k = 0; k < count && !this.done; ++k) loss = this.module.calls.step(this.handle);
    return { iteration: this.iteration, count: this.count, loss };
  }

  get iteration() {
    return this.module.calls.iteration(this.handle);
  }

  get iterations() {
    return this.recipe.iterations;
  }

  get done() {
    return this.iteration >= this.iterations;
  }

  /** Number of Gaussians. */
  get count() {
    return this.module.calls.count(this.handle);
  }

  /** The scene from a camera: { image (3 H W), transmittance (H W) }, Float32Array. */
  render(camera) {
    const pixels = camera.W * camera.H;
    return this.module.withRoom(({ room, given }) => {
      const image = room(Float32Array, 3 * pixels);
      const transmittance = room(Float32Array, pixels);
      const numbers = given(Float64Array, cameraNumbers(camera)).address;
      this.module.calls.render(this.handle, numbers, image.address, transmittance.address);
      return { image: image.view().slice(), transmittance: transmittance.view().slice() };
    });
  }

  /** The scene against a photo: { psnr (dB), ssim, l1 }. */
  score({ camera, pixels }) {
    return this.module.withRoom(({ room, given }) => {
      const out = room(Float64Array, 3);
      const numbers = given(Float64Array, cameraNumbers(camera)).address;
      this.module.calls.score(this.handle, numbers, given(Uint8Array, pixels).address, out.address);
      const [squared, l1, ssim] = out.view();
      return { psnr: -10 * Math.log10(Math.max(squared, 1e-10)), ssim, l1 };
    });
  }

  /** The raw parameters by name, copies, and their `count`. */
  gaussians() {
    const count = this.count;
    const K = (this.recipe.sh_degree + 1) ** 2 - 1;
    const widths = [3, 4, 3, 3, 3 * K, 1];
    const found = { count };
    PARAMETERS.forEach((name, group) => {
      const address = this.module.calls.parameter(this.handle, group) >>> 0;
      found[name] = new Float32Array(this.module.memory.buffer, address, widths[group] * count).slice();
    });
    return found;
  }

  /** Everything that the steps changed, as bytes for `load`. */
  state() {
    return this.module.withRoom(({ room }) => {
      const size = room(Uint32Array, 1);
      const address = this.module.calls.state(this.handle, size.address) >>> 0;
      const bytes = new Uint8Array(this.module.memory.buffer, address, size.view()[0]).slice();
      this.module.calls.release(address);
      return bytes;
    });
  }

  /** Continues from a state that a training with the same photos and settings wrote. */
  load(bytes) {
    this.module.withRoom(({ given }) =>
      this.module.calls.load(this.handle, given(Uint8Array, bytes).address, bytes.length),
    );
  }

  /** A trainer that continues from a state. */
  static resumed(module, options, state) {
    const trainer = new Trainer(module, options);
    trainer.load(state);
    return trainer;
  }

  /** Releases the memory. */
  free() {
    this.module.calls.end_training(this.handle);
    this.handle = 0;
  }
}
