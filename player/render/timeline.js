// The index of a scene that is cut in time.

/** @typedef {{file: string, bytes: number, base: number | null, range: [number, number]}} Segment */
/** base: its number in the index. The first segment of each begins at `range[0]`.
 * @typedef {{bases: {file: string, bytes: number}[], segments: Segment[]}} Index */

/** Limits: bytes of an index, its segments. */
export const MOST_BYTES = 2 ** 25;
const MOST_SEGMENTS = 2 ** 16;
const NAME = /^[A-Za-z0-9_][A-Za-z0-9_.-]{0,119}$/;

/** Whether an address is that of an index. @param {string | Blob} from */
export const isIndex = (from) => typeof from === "string" && new URL(from).pathname.endsWith(".json");

/** The number of the segment that shows a time: the last one that begins by then.
 * @param {{range: [number, number]}[]} segments @param {number} seconds */
export function segmentAt(segments, seconds) {
  let [low, high] = [0, segments.length];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (segments[middle].range[0] <= seconds) low = middle;
    else high = middle;
  }
  return low;
}

/** The numbers of the segments that show a time, the later one first.
 * @param {{range: [number, number]}[]} segments @param {number} seconds */
export function segmentsAt(segments, seconds) {
  const now = segmentAt(segments, seconds);
  return now && seconds < segments[now - 1].range[1] ? [now, now - 1] : [now];
}

/** The weight of a segment where the one before it overlaps it. @param {{range: [number, number]}[]} segments
 * @param {number} k of the segment @param {number} seconds */
export function weightAt(segments, k, seconds) {
  const [from, to] = [segments[k].range[0], segments[k - 1].range[1]];
  return Math.min(Math.max((seconds - from) / (to - from), 0), 1);
}

/** Reads an index, which is not trusted. @param {string} text @returns {Index} */
export function parseIndex(text) {
  const content = JSON.parse(text);
  /** @param {boolean} fine @param {string} what */
  const expect = (fine, what) => {
    if (!fine) throw new Error(`the index of segments is invalid: ${what}`);
  };
  expect(content?.segments_version === 1, "expected segments_version 1");
  const { bases, segments } = content;
  /** @param {unknown} list @param {string} what */
  const check = (list, what) => {
    expect(Array.isArray(list) && list.length <= MOST_SEGMENTS, `expected at most ${MOST_SEGMENTS} ${what}`);
    for (const row of /** @type {any[]} */ (list)) {
      const fine = NAME.test(row?.file) && Number.isSafeInteger(row.bytes) && row.bytes > 0;
      expect(fine, `expected names and sizes of ${what}`);
    }
  };
  check(bases, "bases");
  check(segments, "segments");
  expect(segments.length > 0, "expected one segment at least");
  /** @type {Segment[]} */
  const found = [];
  for (const { file, bytes, base, time_range } of segments) {
    const [start, end] = Array.isArray(time_range) ? time_range : [];
    const before = found[found.length - 1]?.range ?? [-Infinity, Infinity];
    const second = found[found.length - 2]?.range ?? [-Infinity, -Infinity];
    const ordered = Number.isFinite(start) && Number.isFinite(end) && start < end;
    expect(ordered && start > before[0] && start <= before[1] && (end > before[1] || !found.length), "times out of order");
    expect(start >= second[1], "three segments at a time");
    expect(base === null || (Number.isInteger(base) && base >= 0 && base < bases.length), "an unknown base");
    found.push({ file, bytes, base, range: [start, end] });
  }
  return { bases, segments: found };
}
