// The reader of remote files against a server in this process that behaves as it is told.

import assert from "node:assert/strict";
import { createServer } from "node:http";
import { after, test } from "node:test";
import { gzipSync } from "node:zlib";

import { decode } from "../decode/index.js";
import { SceneSource } from "../decode/fetch.js";
import { endsOf, readVector, same } from "../testing/vectors.mjs";

const BYTES = readVector("valid/layers-0-1-2");
const OTHER = readVector("valid/layers-0-1");
const ENDS = endsOf(BYTES).map(({ end }) => end);

/**
 * A server of one file. What it does for request i, counted from 0, is behave(i): `bytes` of the file, cut after `cut`
 * bytes of the answer, or never ended if `hang`, or ended in order there if `short`; `body` in place of the answer's,
 * in small pieces; `ranges`, `tag`, `status`, and `headers` besides the usual ones, as they say.
 *
 * @typedef {{bytes?: Uint8Array, cut?: number, hang?: boolean, short?: boolean, body?: Uint8Array, ranges?: boolean,
 *   tag?: string | null, status?: number, headers?: Record<string, string>}} Act
 */

/** @type {import("node:http").Server[]} */
const servers = [];
after(() => servers.forEach((server) => server.closeAllConnections()));

/** A server, and a source of its file. @param {(i: number) => Act} [behave]
 * @param {import("../decode/fetch.js").SourceOptions} [options] */
async function serving(behave = () => ({}), options = {}) {
  /** The range of each request. @type {(string | undefined)[]} */
  const asked = [];
  const server = createServer((request, response) => {
    const { bytes = BYTES, cut, hang, short, body, ranges = true, tag = '"a"', status, ...act } =
      behave(asked.length);
    const { range } = request.headers;
    asked.push(range);
    if (status) {
      response.writeHead(status).end("no");
      return;
    }
    const wanted = ranges ? Number(/bytes=(\d+)-/.exec(range ?? "")?.[1] ?? 0) : 0;
    if (wanted >= bytes.length) {
      response.writeHead(416).end();
      return;
    }
    const part = bytes.subarray(wanted, short ? wanted + (cut ?? 0) : undefined);
    /** @type {Record<string, string | number>} */
    const headers = { "Content-Length": body?.length ?? part.length };
    if (tag !== null) headers["ETag"] = tag;
    if (wanted) headers["Content-Range"] = `bytes ${wanted}-${bytes.length - 1}/${bytes.length}`;
    response.writeHead(wanted ? 206 : 200, { ...headers, ...act.headers });
    if (body) {
      for (let at = 0; at < body.length; at += 100) response.write(body.subarray(at, at + 100));
      response.end();
    } else if (cut === undefined || short) response.end(part);
    else response.write(part.subarray(0, cut), () => (hang ? undefined : setTimeout(() => response.destroy(), 20)));
  });
  servers.push(server);
  await new Promise((resolve) => server.listen(0, "127.0.0.1", () => resolve(undefined)));
  server.unref();
  const { port } = /** @type {import("node:net").AddressInfo} */ (server.address());
  const url = `http://127.0.0.1:${port}/scene.pd4`;
  return { asked, source: new SceneSource(url, { pause: 0.01, stall: 5, ...options }) };
}

/** @param {SceneSource} source @param {import("../decode/fetch.js").Budget} [budget] */
async function all(source, budget) {
  const scenes = [];
  for await (const scene of source.scenes(budget)) scenes.push(scene);
  return scenes;
}

/** The layers of the scenes before an error. @param {SceneSource} source @param {object} error */
async function before(source, error) {
  /** @type {number[][]} */
  const seen = [];
  const run = async () => {
    for await (const { layers } of source.scenes()) seen.push(layers);
  };
  await assert.rejects(run(), error);
  return seen;
}

/** @param {import("../decode/index.js").Scene[]} scenes */
const layersOf = (scenes) => scenes.map(({ layers }) => layers);

test("one request gives every layer", async () => {
  const { source, asked } = await serving();
  const scenes = await all(source);
  assert.deepEqual(layersOf(scenes), [[0], [0, 1], [0, 1, 2]]);
  assert.ok(same(scenes[2], decode(BYTES)));
  assert.deepEqual(asked, [undefined]);
  assert.equal(source.received, BYTES.length);
});

test("a budget of layers or bytes stops, and a later call continues", async () => {
  for (const budget of [{ maxLayer: 0 }, { bytes: ENDS[0] }, { bytes: ENDS[1] - 1 }]) {
    const { source, asked } = await serving();
    assert.deepEqual(layersOf(await all(source, budget)), [[0]]);
    assert.equal(source.received, ENDS[0], "nothing behind the layer is decoded or counted");
    const rest = await all(source);
    assert.deepEqual(layersOf(rest), [[0, 1], [0, 1, 2]]);
    assert.ok(same(rest[1], decode(BYTES)));
    assert.equal(asked[1], `bytes=${ENDS[0]}-`);
    assert.deepEqual(await all(source), []);
    assert.equal(asked.length, 2);
  }
});

test("bytes that end before the first slice yield nothing", async () => {
  assert.deepEqual(await all((await serving()).source, { bytes: ENDS[0] - 1 }), []);
});

test("seconds count from the first slice, in a later call from its beginning", async () => {
  const { source } = await serving();
  assert.deepEqual(layersOf(await all(source, { seconds: 0 })), [[0]]);
  assert.deepEqual(await all(source, { seconds: 0 }), []);
  assert.equal((await all(source)).length, 2);

  const slow = await serving(() => ({ cut: ENDS[0] + 2, hang: true }));
  const start = performance.now();
  assert.deepEqual(layersOf(await all(slow.source, { seconds: 0.2 })), [[0]]);
  assert.ok(performance.now() - start < 3000, "the stalled connection is not waited for");
});

test("a download resumes after a cut anywhere, and requests no byte twice", async () => {
  for (const cut of [5, 30, 300, ENDS[0], ENDS[1] + 3]) {
    const { source, asked } = await serving((i) => (i < 2 ? { cut } : {}));
    const scenes = await all(source);
    assert.ok(same(scenes[scenes.length - 1], decode(BYTES)));
    assert.equal(scenes.length, 3);
    assert.equal(asked[1], `bytes=${cut}-`);
    assert.ok(source.cuts >= 1);
    assert.equal(source.changes, 0);
  }
});

test("a stalled connection counts as cut", async () => {
  const { source, asked } = await serving((i) => (i === 0 ? { cut: 400, hang: true } : {}), { stall: 0.2 });
  assert.equal((await all(source)).length, 3);
  assert.deepEqual([asked.length, source.cuts], [2, 1]);
});

test("a server without ranges sends the same file again, whose known bytes are skipped", async () => {
  const { source, asked } = await serving((i) => (i === 0 ? { cut: ENDS[0] + 5, ranges: false } : { ranges: false }));
  assert.deepEqual(layersOf(await all(source)), [[0], [0, 1], [0, 1, 2]]);
  assert.deepEqual([asked.length, source.changes], [2, 0]);
});

test("a changed file restarts with its layer 0", async () => {
  for (const ranges of [true, false]) {
    const { source } = await serving((i) => (i === 0 ? { cut: ENDS[0] + 5 } : { bytes: OTHER, tag: '"b"', ranges }));
    const scenes = await all(source);
    assert.deepEqual(layersOf(scenes), [[0], [0], [0, 1]]);
    assert.ok(same(scenes[2], decode(OTHER)));
    assert.equal(source.changes, 1);
  }
});

/** As a browser shows a response of another origin that exposes nothing. @type {typeof fetch} */
const hidden = async (url, options) => {
  const { status, statusText, headers, body } = await fetch(url, options);
  const length = headers.get("Content-Length");
  return new Response(body, { status, statusText, headers: length ? { "Content-Length": length } : {} });
};
const ZIPPED = gzipSync(BYTES, { level: 9 });
const GZIP = { body: ZIPPED, headers: { "Content-Encoding": "gzip" } };

/** What servers, and browsers in between, make of one file. @type {Record<string, [(i: number) => Act, object?]>} */
const INTACT = {
  "gzip, its length not the file's": [() => GZIP, { fetch: hidden }],
  "gzip with a length that is longer": [() => ({ ...GZIP, body: gzipSync(BYTES, { level: 0 }) }), { fetch: hidden }],
  "a weak tag": [(i) => (i ? { tag: '"a"' } : { cut: ENDS[0] + 5, tag: 'W/"a"' })],
  "weak tags": [(i) => ({ tag: 'W/"a"', ...(i === 0 && { cut: ENDS[0] + 5 }) })],
  "no tag": [(i) => ({ tag: null, ...(i === 0 && { cut: 400 }) })],
  "no tag that is shown, nor a range": [(i) => (i ? {} : { cut: ENDS[0] + 5 }), { fetch: hidden }],
  "no tag, no ranges": [(i) => ({ tag: null, ranges: false, ...(i === 0 && { cut: ENDS[0] + 5 }) })],
  "a range of an unknown whole": [
    (i) => (i ? { headers: { "Content-Range": `bytes ${ENDS[0] + 5}-${BYTES.length - 1}/*` } } : { cut: ENDS[0] + 5 }),
  ],
  "a range from the first byte on": [
    (i) =>
      i
        ? { body: BYTES, headers: { "Content-Range": `bytes 0-${BYTES.length - 1}/${BYTES.length}` } }
        : { cut: ENDS[0] + 5 },
  ],
  "short answers that end in order": [() => ({ short: true, cut: 200 })],
  "no length, and an end that is none": [
    (i) => (i ? {} : { short: true, cut: ENDS[0] + 5, headers: { "Content-Length": "" } }), { fetch: hidden },
  ],
};

for (const [name, [behave, options]] of Object.entries(INTACT)) {
  test(`an intact file is whole: ${name}`, async () => {
    const { source, asked } = await serving(behave, options);
    const scenes = await all(source);
    assert.ok(same(scenes[scenes.length - 1], decode(BYTES)));
    assert.equal(source.changes, 0);
    assert.deepEqual([source.received, source.total], [BYTES.length, BYTES.length]);
    assert.ok(asked.length < 3 + BYTES.length / 200);
  });
}

test("of a changed file that no tag gives away, the checksums do", async () => {
  const bytes = readVector("valid/slices"); // as long as the layer that was begun
  const { source } = await serving((i) => (i ? { bytes } : { cut: ENDS[0] + 5 }), { fetch: hidden });
  const scenes = await all(source);
  assert.ok(same(scenes[scenes.length - 1], decode(bytes)));
  assert.equal(source.changes, 1);
});

test("a body that neither ends nor fails is given up", { timeout: 20_000 }, async () => {
  const stuck = { pull: () => new Promise(() => {}) }; // as Node's of gzip with a wrong checksum, even if aborted
  const answer = async () => new Response(new ReadableStream(stuck));
  const { source } = await serving(undefined, { fetch: answer, stall: 0.1, attempts: 2 });
  await assert.rejects(all(source), { name: "FetchError", message: /timed out/ });
});

test("a server's words cannot reach the terminal as they are", async () => {
  const answer = /** @type {Response} */ ({ status: 404, statusText: "\x1b[31mgone", headers: new Headers() });
  const { source } = await serving(undefined, { fetch: async () => answer });
  await assert.rejects(all(source), { message: /404 \\u001b\[31mgone$/ });
});

test("a file that changes at every request is given up", async () => {
  const { source } = await serving((i) => ({ cut: 400, tag: `"${i}"` }));
  await assert.rejects(all(source), { name: "FetchError", message: /changed/ });
});

test("a damaged layer is fetched once more, and is an error the second time", async () => {
  const damaged = BYTES.slice();
  damaged[ENDS[1] - 30] ^= 1;
  const { source, asked } = await serving((i) => (i === 0 ? { bytes: damaged } : {}));
  const scenes = await all(source);
  assert.deepEqual(layersOf(scenes), [[0], [0, 1], [0, 1, 2]]);
  assert.ok(same(scenes[2], decode(BYTES)));
  assert.equal(asked[1], `bytes=${ENDS[0]}-`);
  const always = await serving(() => ({ bytes: damaged }));
  const fault = { kind: "ChecksumMismatch", chunk: 1 };
  assert.deepEqual(await before(always.source, fault), [[0]]);
  assert.equal(always.asked.length, 2);
});

test("a file of another type is refused at its first bytes", async () => {
  const bytes = new TextEncoder().encode("<!doctype html>" + "x".repeat(1 << 16));
  const { source, asked } = await serving(() => ({ bytes }));
  await assert.rejects(all(source), { kind: "BadSignature" });
  assert.equal(asked.length, 1);
});

test("a file that ends within a layer is Truncated", async () => {
  for (const ranges of [true, false]) {
    const { source, asked } = await serving(() => ({ bytes: BYTES.subarray(0, ENDS[1] - 7), ranges }));
    assert.deepEqual(await before(source, { kind: "Truncated" }), [[0]]);
    assert.equal(asked.length, 2, "its header says that more follows, which is asked for once");
  }
});

test("temporary status codes are tried again, others are final, and a dead server is given up", async () => {
  const passing = await serving((i) => (i < 2 ? { status: 503 } : {}));
  assert.equal((await all(passing.source)).length, 3);
  const gone = await serving(() => ({ status: 404 }));
  await assert.rejects(all(gone.source), /404/);
  assert.equal(gone.asked.length, 1);
  const dead = await serving(() => ({ status: 500 }), { attempts: 3 });
  await assert.rejects(all(dead.source), { name: "FetchError" });
  assert.equal(dead.asked.length, 3);
});

test("an answer that breaks is told from none", async () => {
  const { source } = await serving(() => ({ cut: 0 }), { attempts: 2 });
  await assert.rejects(all(source), { name: "FetchError", message: /the connection broke \(0 bytes received\)$/ });
  const none = await serving(undefined, { attempts: 2, fetch: () => Promise.reject(new TypeError("fetch failed")) });
  await assert.rejects(all(none.source), { message: /no connection, or no CORS permission of the server \(0 bytes/ });
});

test("an abort raises the signal's reason, before and during the download", async () => {
  const controller = new AbortController();
  const { source } = await serving(() => ({ cut: ENDS[0] + 5, hang: true }), { signal: controller.signal });
  const reason = new Error("enough");
  const run = async () => {
    for await (const { layers } of source.scenes()) {
      assert.deepEqual(layers, [0]);
      setTimeout(() => controller.abort(reason), 20);
    }
  };
  await assert.rejects(run(), reason);
  await assert.rejects(all(source), reason);
});

test("after the seconds of a budget, a later call continues", async () => {
  const { source, asked } = await serving((i) => (i === 0 ? { cut: ENDS[0] + 5, hang: true } : {}));
  assert.deepEqual(layersOf(await all(source, { seconds: 0.5 })), [[0]]);
  assert.equal(source.received, ENDS[0] + 5);
  assert.equal((await all(source)).length, 2);
  assert.equal(asked[1], `bytes=${ENDS[0] + 5}-`);
});

test("progress is told as bytes arrive", async () => {
  /** @type {[number, number | null][]} */
  const told = [];
  const { source } = await serving(undefined, { progress: (...figures) => void told.push(figures) });
  await all(source);
  assert.deepEqual(told[told.length - 1], [BYTES.length, BYTES.length]);
  told.forEach(([received], i) => assert.ok(!i || received > told[i - 1][0]));
});
