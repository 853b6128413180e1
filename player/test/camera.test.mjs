// Cameras of windows.

import assert from "node:assert/strict";
import { test } from "node:test";

import { fitted } from "../render/camera.js";

/** @param {number} width @param {number} height */
const camera = (width, height) => ({
  viewmat: new Float32Array(16), K: new Float32Array([500, 0, width / 2, 0, 500, height / 2, 0, 0, 1]), width, height,
});

for (const [name, capture, window, seen] of /** @type {[string, number[], number[], number[]][]} */ ([
  ["a wide one shows all of a wide capture", [640, 360], [1200, 600], [720, 360]],
  ["a squarer one shows all of it", [640, 360], [400, 300], [640, 480]],
  ["an upright one shows nothing above and below a wide capture", [640, 360], [360, 720], [180, 360]],
  ["an upright one shows nothing beside an upright capture", [360, 640], [500, 600], [360, 432]],
  ["one of the capture's shape shows the capture", [360, 640], [180, 320], [360, 640]],
])) {
  test(`windows: ${name}`, () => {
    const { K } = fitted(camera(capture[0], capture[1]), window[0], window[1]);
    [0, 1].forEach((axis) => assert.ok(Math.abs((500 / K[4 * axis]) * window[axis] - seen[axis]) < 1e-3));
    assert.deepEqual([K[2], K[5]], window.map((side) => side / 2));
  });
}
