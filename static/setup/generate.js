// Positions made from one position by placing some of its objects anew: in a grid, at random, or as a Latin hypercube. Needs no
// page.

import { placed, problems, reachable, things } from "./bench.js";

const TRIES = 4000; // attempts per random position
const DRAWS = 200; // draws of a Latin hypercube, until all of it can be laid out

/**
 * Make benches like `bench` with the objects `keys` placed anew within `area` [mm: x from, to, y from, to], and turned by at
 * most `turn` degrees from their present angles. Make `n` of them, or a grid of `columns` x `rows`, which moves one object.
 * Return {benches, left}, where `left` counts those that could not be laid out, because something was too close or out of
 * reach.
 */
export function generated({ method, bench, sizes, keys, area, turn = 0, n, columns, rows, least = 0, seed = 1 }) {
  const chance = numbers(seed);
  const lay = (shares) => laid(bench, sizes, keys, area, turn, shares);
  const good = (one) => problems(one, sizes).length === 0 && things(one, sizes).every((thing) => !keys.includes(thing.key) || reachable(thing, sizes));
  if (method === "grid") {
    const all = grid(columns, rows).map((shares) => lay(shares));
    const benches = all.filter(good);
    return { benches, left: all.length - benches.length };
  }
  if (method === "hypercube") return hypercube(n, 3 * keys.length, chance, lay, good);
  const benches = [];
  for (let tries = 0; benches.length < n && tries < TRIES * n; tries += 1) {
    const one = lay(Array.from({ length: 3 * keys.length }, chance));
    if (good(one) && benches.every((other) => distance(one, other, sizes) >= least)) benches.push(one);
  }
  return { benches, left: n - benches.length };
}

/** Return the distance of two benches [mm]: the largest distance between the two places of one object. */
export function distance(one, other, sizes) {
  const before = new Map(things(other, sizes).map((thing) => [thing.key, thing]));
  const ways = things(one, sizes).map(({ key, x, y }) => (before.has(key) ? Math.hypot(x - before.get(key).x, y - before.get(key).y) : 0));
  return Math.max(0, ...ways);
}

/** Return the least distance between any two of the benches; Infinity if there are fewer than two. */
export function nearest(benches, sizes) {
  let least = Infinity;
  benches.forEach((one, index) => benches.slice(index + 1).forEach((other) => (least = Math.min(least, distance(one, other, sizes)))));
  return least;
}

/** Place each object by three shares of its ranges: along x, along y, and of its rotation. */
function laid(bench, sizes, keys, [left, right, near, far], turn, shares) {
  let made = bench;
  keys.forEach((key, index) => {
    const thing = things(made, sizes).find((one) => one.key === key);
    const [x, y, yaw] = shares.slice(3 * index, 3 * index + 3);
    made = placed(made, thing, {
      x: Math.round(left + x * (right - left)),
      y: Math.round(near + y * (far - near)),
      yaw: Math.round(thing.yaw + turn * (2 * yaw - 1)),
    });
  });
  return made;
}

function grid(columns, rows) {
  const share = (index, count) => (count > 1 ? index / (count - 1) : 0.5);
  return Array.from({ length: rows * columns }, (_, k) => [share(k % columns, columns), share(Math.floor(k / columns), rows), 0.5]);
}

/**
 * Use each of n slices of each range once. Draw again until all can be laid out, else return the draw with the most that can.
 */
function hypercube(n, dimensions, chance, lay, good) {
  let best = [];
  for (let draw = 0; draw < DRAWS && best.length < n; draw += 1) {
    const slices = Array.from({ length: dimensions }, () => shuffled(n, chance));
    const benches = Array.from({ length: n }, (_, k) => lay(slices.map((slice) => (slice[k] + chance()) / n))).filter(good);
    if (benches.length > best.length) best = benches;
  }
  return { benches: best, left: n - best.length };
}

function shuffled(n, chance) {
  const found = Array.from({ length: n }, (_, k) => k);
  for (let k = n - 1; k > 0; k -= 1) {
    const other = Math.floor(chance() * (k + 1));
    [found[k], found[other]] = [found[other], found[k]];
  }
  return found;
}

/** Return a generator of numbers from 0 to below 1, the same for the same seed (mulberry32). */
export function numbers(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 4294967296;
  };
}
