/** Numbers of Gaussians in one precision, which is also that of the arithmetic. */
export type Numbers = Float32Array | Float64Array;

/** A camera in OpenCV's axes (right, down, forward); pixel centres are at whole numbers: u = fx x/z + cx. */
export interface Camera {
  /** Rotation from world to camera, row by row: x_cam = R (x - eye). */
  R: ArrayLike<number>;
  /** Centre, world units. */
  eye: ArrayLike<number>;
  /** Focal lengths and principal point, px. */
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** Size of the image, px. */
  W: number;
  H: number;
}

/** N Gaussians by their raw parameters. */
export interface Gaussians<T extends Numbers = Float32Array> {
  /** N 3, world units. */
  means: T;
  /** N 4, (w, x, y, z) of any length. */
  quats: T;
  /** N 3, logarithms of standard deviations. */
  log_scales: T;
  /** N 3, harmonics of degree 0. */
  sh0: T;
  /** N K 3, the higher harmonics: K is 0, 3, 8 or 15. */
  sh_rest: T;
  /** N, logits of opacities. */
  logit_opacities: T;
}

export interface RenderSettings {
  /** RGB, 0 to 1; black by default. */
  background?: ArrayLike<number>;
  /** Degree of harmonics in use; at most that of the Gaussians, and 3 by default. */
  shDegree?: number;
  antialiased?: boolean;
  /** Clamp of the projection's Jacobian, in half fields of view; null clamps nothing. */
  jacobianLimit?: number | null;
  /** Added to the ellipses' covariance, px². */
  dilation?: number;
  alphaMax?: number;
  zNear?: number;
  /** Ends each pixel by itself, instead of the whole tile. */
  pixelStop?: boolean;
}

/** H W 3, and H W. */
export interface Images<T extends Numbers = Float32Array> {
  image: T;
  transmittance: T;
  depth: T;
  median_depth: T;
}

export interface Gradients<T extends Numbers = Float32Array> extends Gaussians<T> {
  background: T;
  /** R row by row, the eye, fx, fy, cx, cy. */
  camera: Float64Array;
}

/** Something that cannot be done with what was given; the message is one sentence for people. */
export class EngineError extends Error {}

export interface Module {
  /** Bytes of memory in use. */
  readonly bytes: number;
  readonly threads: number;
  /** Ends the threads; the module is not used afterwards. */
  close(): void;
}

export interface LoadOptions {
  /** Most bytes of memory, up to 4 GiB; 2 GiB by default. */
  limit?: number;
  /** More than one needs gsplat_edu_threads.wasm, and a page that is cross-origin isolated. */
  threads?: number;
  startWorker?: (url: URL) => Worker;
}

export const DEFAULT_LIMIT: number;

export function loadModule(
  source: BufferSource | WebAssembly.Module | URL | string,
  options?: LoadOptions,
): Promise<Module>;

export function render<T extends Numbers>(
  module: Module,
  gaussians: Gaussians<T>,
  camera: Camera,
  settings?: RenderSettings,
): Images<T>;

/** Also differentiates the sum of the images times `upstream`. */
export function render<T extends Numbers>(
  module: Module,
  gaussians: Gaussians<T>,
  camera: Camera,
  settings: RenderSettings,
  upstream: { image: T; transmittance?: T; depth?: T },
): Images<T> & { gradients: Gradients<T> };

/** A photo of the scene: RGB, 3 bytes a pixel. */
export interface View {
  name: string;
  camera: Camera;
  pixels: Uint8Array;
}

export interface TrainerOptions {
  /** Where to start: N 3 positions in world units, and N 3 colours from 0 to 1. */
  points: ArrayLike<number>;
  colors: ArrayLike<number>;
  views: View[];
  /** Size of the scene, world units; by default from the spread of the cameras. */
  extent?: number;
  settings: {
    iterations: number;
    /** By default planned from the number of views and their size. */
    maxGaussians?: number;
    shDegree?: number;
    seed?: number;
    background?: ArrayLike<number>;
  };
}

/** A training with the recipe fast. The same options give the same bits, for any number of threads, and after `load`. */
export class Trainer {
  constructor(module: Module, options: TrainerOptions);
  static resumed(module: Module, options: TrainerOptions, state: Uint8Array): Trainer;
  readonly iteration: number;
  readonly iterations: number;
  readonly done: boolean;
  /** Number of Gaussians now, and at the end. */
  readonly count: number;
  readonly planned: number;
  /** Takes steps, at most to the end of the run. */
  step(count?: number): { iteration: number; count: number; loss: number };
  render(camera: Camera): { image: Float32Array; transmittance: Float32Array };
  score(view: View): { psnr: number; ssim: number; l1: number };
  gaussians(): Gaussians & { count: number };
  /** Everything that the steps changed, for `load` in a trainer with the same options. */
  state(): Uint8Array;
  load(state: Uint8Array): void;
  free(): void;
}

export function recipe(iterations: number, changes?: Record<string, number>): Record<string, number>;
export function plannedGaussians(pixels: number, views: number, separate?: number): number;
export function sceneExtent(cameras: Camera[]): number;
