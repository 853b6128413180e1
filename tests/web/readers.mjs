// Reads a package as mp4box.js, dash.js and hls.js see it and prints what they found as JSON.
// node readers.mjs MODULES URL: the folder of node_modules, and where the package is served.
import { createHash } from 'node:crypto';
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';

const [modules, url] = process.argv.slice(2);
const require = createRequire(pathToFileURL(modules + '/'));
const load = (name, file) => import(pathToFileURL(file ? `${modules}/${name}/${file}` : require.resolve(name)));
const version = (name) => JSON.parse(require('node:fs').readFileSync(`${modules}/${name}/package.json`)).version;
const get = async (name, range) => {
  const answer = await fetch(url + name, range ? { headers: { Range: `bytes=${range}` } } : {});
  if (!answer.ok) throw new Error(`${name}: ${answer.status}`);
  return new Uint8Array(await answer.arrayBuffer());
};
const sha256 = (parts) => parts.reduce((hash, part) => hash.update(part), createHash('sha256')).digest('hex');
const list = (value) => (value === undefined ? [] : Array.isArray(value) ? value : [value]);

async function samplesOf(bytes) {
  const { createFile } = await load('mp4box');
  const file = createFile();
  const samples = [];
  await new Promise((resolve, reject) => {
    file.onError = reject;
    file.onReady = (info) => {
      file.onSamples = (id, user, found) => found.forEach((sample) => samples.push([id, sample.data]));
      info.tracks.forEach((track) => file.setExtractionOptions(track.id, null, { nbSamples: 1 }));
      file.start();
      resolve();
    };
    const buffer = bytes.slice().buffer;
    buffer.fileStart = 0;
    file.appendBuffer(buffer);
    file.flush();
  });
  samples.sort((a, b) => a[0] - b[0]);
  return { tracks: samples.map(([id]) => id), sha256: sha256(samples.map(([, data]) => data)) };
}

async function dash(name) {
  const { JSDOM } = await load('jsdom');
  const { window } = new JSDOM('', { url });
  globalThis.window = globalThis.self = window;
  for (const key of Object.getOwnPropertyNames(window)) {
    if (!(key in globalThis)) globalThis[key] = window[key];
  }
  window.MediaSource = globalThis.MediaSource = class { static isTypeSupported() { return true; } };
  const { MediaPlayer } = await load('dashjs', 'dist/modern/esm/dash.all.min.js');
  const player = MediaPlayer().create();
  player.updateSettings({ debug: { logLevel: 0 } });
  const manifest = await new Promise((resolve, reject) => {
    player.on('manifestLoaded', (event) => resolve(event.data));
    player.on('error', (event) => reject(new Error(event.error.message)));
    player.initialize(window.document.createElement('video'), url + name, false);
  });
  const layers = [];
  const parts = [];
  for (const set of manifest.Period[0].AdaptationSet) {
    for (const representation of list(set.Representation)) {
      if (set.contentType !== 'application') continue;
      const ranges = list(representation.SegmentList.SegmentURL).map((segment) => segment.mediaRange);
      if (!parts.length) parts.push(await get('scene.mp4', representation.SegmentList.Initialization.range));
      layers.push({ id: representation.id, dependencyId: representation.dependencyId ?? null, ranges });
      for (const range of ranges) parts.push(await get('scene.mp4', range));
    }
  }
  window.close();
  const samples = await samplesOf(Buffer.concat(parts));
  return { version: version('dashjs'), layers, sets: manifest.Period[0].AdaptationSet.length, ...samples };
}

async function hls(name) {
  const { M3U8Parser } = await load('hls.js', 'dist/hls.mjs');
  const text = new TextDecoder().decode(await get(name));
  const main = M3U8Parser.parseMasterPlaylist(text, url + name);
  const levels = main.levels.map((level) => level.url);
  const fragments = [];
  for (const level of levels) {
    const playlist = new TextDecoder().decode(await get(level.slice(url.length)));
    const details = M3U8Parser.parseLevelPlaylist(playlist, level, 0, 'main', 0, null);
    if (details.playlistParsingError) throw details.playlistParsingError;
    for (const part of details.fragments) fragments.push(part.byteRange);
  }
  return { version: version('hls.js'), sessionData: main.sessionData, levels, fragments };
}

const boxes = { version: version('mp4box'), ...(await samplesOf(await get('scene.mp4'))) };
console.log(JSON.stringify({ mp4box: boxes, dash: await dash('scene.mpd'), hls: await hls('scene.m3u8') }));
process.exit(0); // players keep timers
