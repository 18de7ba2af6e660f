// Several episodes on one time axis: when each begins, how long they are together, and their curves at common times.

import { lastNotAbove } from "../site/binary_search.js";

/**
 * Return when each of `count` episodes begins: `offsets` [s] as given, `shifts` [s] on a clock that begins with the first one.
 */
export function startTimes(said, count) {
  const numbers = (said ?? "").split(",").map(Number);
  const offsets = Array.from({ length: count }, (_, index) => (Number.isFinite(numbers[index]) ? numbers[index] : 0));
  const first = Math.min(...offsets);
  return { offsets, shifts: offsets.map((offset) => offset - first) };
}

/** Return {fps, frames} of a clock that covers all `episodes` ({fps, frames}); it has the rate of the fastest. */
export function commonClock(episodes, { shifts }) {
  const fps = Math.max(...episodes.map((episode) => episode.fps));
  const end = Math.max(...episodes.map(({ frames, fps: own }, index) => shifts[index] + frames / own));
  return { fps, frames: Math.max(1, Math.ceil(end * fps - 1e-6)) };
}

/** Return the times of all rows of a clock [s]. */
export function clockTimes({ fps, frames }) {
  return Array.from({ length: frames }, (_, row) => row / fps);
}

/**
 * Return the index in `joints` of the joint whose state differs most between the episodes at one time; the first if none
 * differs.
 */
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

/**
 * Return state and executed action of a joint at `times` as {state, executed}; null at times for which the episode has no
 * value.
 */
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
