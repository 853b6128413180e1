// A browser's Worker in Node, as far as the player uses it: import this before what starts workers.

import { after } from "node:test";
import { Worker as Thread } from "node:worker_threads";

/** What workers expect around them. */
const AROUND = `
const { parentPort, workerData } = require("node:worker_threads");
globalThis.addEventListener = (_, take) => parentPort.on("message", (data) => take({ data }));
globalThis.postMessage = (message, { transfer }) => parentPort.postMessage(message, transfer);
import(workerData);`;

let threads = 0;

class Worker {
  /** @param {URL} url */
  constructor(url) {
    threads++;
    this._thread = new Thread(AROUND, { eval: true, workerData: url.href });
    this._thread.on("message", (data) => this.onmessage({ data }));
    this._thread.on("exit", () => threads--);
  }

  /** @param {{data: any}} _event */
  onmessage(_event) {}

  /** @param {any} message @param {any[]} transfer */
  postMessage(message, transfer) {
    this._thread.postMessage(message, transfer);
  }

  terminate() {
    this._thread.terminate();
  }
}

Object.assign(globalThis, { Worker, origin: "null", document: { baseURI: "http://localhost/" } });
after(async () => {
  for (let i = 0; threads && i < 500; i++) await new Promise((resolve) => setTimeout(resolve, 20));
  if (threads) throw new Error(`${threads} threads are left`);
});
