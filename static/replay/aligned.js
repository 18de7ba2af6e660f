// Episodes on one time axis: when each begins, how long all of it is, its curves on common times.

import { lastNotAbove } from "../site/binary_search.js";

/** When each of `count` episodes begins: `offsets` [s] as said, `shifts` [s] on a clock that begins with the first. */
export function startTimes(said, count) {
  const numbers = (said ?? "").split(",").map(Number);
  const offsets = Array.from({ length: count }, (_, index) => (Number.isFinite(numbers[index]) ? numbers[index] : 0));
  const first = Math.min(...offsets);
  return { offsets, shifts: offsets.map((offset) => offset - first) };
}

/** {fps, frames} of a clock on which all of the `episodes` ({fps, frames}) fit; its rows are those of the fastest. */
export function commonClock(episodes, { shifts }) {
  const fps = Math.max(...episodes.map((episode) => episode.fps));
  const end = Math.max(...episodes.map(({ frames, fps: own }, index) => shifts[index] + frames / own));
  return { fps, frames: Math.max(1, Math.ceil(end * fps - 1e-6)) };
}

/** The times of all rows of a clock [s]. */
export function clockTimes({ fps, frames }) {
  return Array.from({ length: frames }, (_, row) => row / fps);
}

/** The joint [index of `joints`] whose state differs most between the episodes at a time; the first where none does. */
export function differing(times, read, joints) {
  const spreads = joints.map((joint) => {
    const states = read.map((episode) => sampleAt(times, episode, joint).state);
    return times.reduce((widest, _, at) => {
      const known = states.map((state) => state[at]).filter((value) => value !== null);
      return known.length > 1 ? Math.max(widest, Math.max(...known) - Math.min(...known)) : widest;
    }, 0);
  });
  return spreads.indexOf(Math.max(...spreads));
}

/** State and executed action of a joint at `times`; null where the episode has none: {state, executed}. */
export function sampleAt(times, { header, numbers, shift }, joint) {
  const index = header.joints.indexOf(joint);
  const { arrays } = header.streams.ticks;
  const own = numbers(arrays.time);
  const period = 1.5 * header.period;
  const pick = (name) => {
    if (index < 0) return times.map(() => null);
    const values = numbers(arrays[name]).subarray(index * own.length, (index + 1) * own.length);
    return times.map((time) => {
      const at = lastNotAbove(own, time - shift + 1e-6);
      const known = at >= 0 && time - shift < own[at] + period && Number.isFinite(values[at]);
      return known ? values[at] : null;
    });
  };
  return { state: pick("measured"), executed: pick("executed") };
}
