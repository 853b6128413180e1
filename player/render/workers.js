// Where the code of the workers is: beside this module. A packed page and the npm package hold the code in themselves.

export const WORKERS = {
  loader: new URL("./loader-worker.js", import.meta.url),
  sort: new URL("./sort-worker.js", import.meta.url),
  evaluate: new URL("./evaluate-worker.js", import.meta.url),
};
