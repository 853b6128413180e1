// What draws a scene, by its kind: beside the kinds, because decoders do without.

import { texelsOf } from "../render/evaluate.js";
import { GpuEvaluator } from "../render/evaluator.js";
import { SplatPass } from "../render/splat-pass.js";
import { SplatEvaluator } from "../render/splats.js";
import { kindOf } from "./index.js";
/** @import { CpuEvaluator } from "../render/cpu.js" */
/** @import { Evaluated, Splats } from "../render/evaluator.js" */
/** @import { Gpu } from "../render/gl.js" */
/** @import { Texels } from "../render/level.js" */
/** @import { Lister } from "../render/sort.js" */
/** @import { Scene } from "./index.js" */

/**
 * few: up to so many anchors a machine without a GPU uses the CPU. gpu: missing where shaders cannot draw a kind.
 *
 * @typedef {{evaluate: (level: number, t: number, eye: number[], spare: Texels | null) => Texels}} OnCpu
 * @typedef {{scene: Scene, free: () => void, evaluate: (level: number, t: number, eye: number[], into: Splats | null,
 *   lister: Lister) => Promise<Evaluated>}} OnGpu
 * @typedef {{cpu: (scene: any) => OnCpu, few: number, gpu?: (gpu: Gpu, scene: any, cpu: CpuEvaluator) => OnGpu}} Drawing
 */

/** Of kinds that do not have these themselves. @type {Record<string, Drawing>} */
const DRAWING = {
  scaffold: {
    cpu: (scene) => ({ evaluate: (level, t, eye, spare) => texelsOf(scene, level, t, eye, spare) }),
    few: 30_000, // shaders take seconds to compile without a GPU and are hardly faster
    gpu: (gpu, scene) => new GpuEvaluator(gpu, scene),
  },
  splats: {
    cpu: (scene) => new SplatEvaluator(scene),
    few: Infinity,
    gpu: (gpu, scene, cpu) => new SplatPass(gpu, scene, cpu),
  },
};

/** @param {Scene} scene @returns {Drawing} */
export const drawing = (scene) => DRAWING[scene.kind] ?? kindOf(scene);
