// Fewer points for the same picture: each bucket keeps the smallest and the largest value of every curve, in order, so that no
// spike is lost.

/**
 * Return the indices to draw of the columns `curves` (arrays of one length, NaN for no value), so that at most about `limit`
 * points remain; all indices if there are fewer points.
 */
export function decimate(curves, limit) {
  const length = curves[0]?.length ?? 0;
  const perBucket = 2 * curves.length;
  const buckets = Math.max(1, Math.floor(limit / perBucket));
  if (length <= buckets * perBucket) return Array.from({ length }, (_, index) => index);
  const kept = [];
  for (let bucket = 0; bucket < buckets; bucket += 1) {
    const from = Math.floor((bucket * length) / buckets);
    const to = Math.floor(((bucket + 1) * length) / buckets);
    const chosen = new Set();
    for (const curve of curves) for (const index of extremes(curve, from, to)) chosen.add(index);
    if (!chosen.size) chosen.add(from); // a gap stays a gap
    kept.push(...[...chosen].sort((a, b) => a - b));
  }
  return kept;
}

function extremes(curve, from, to) {
  let low = -1;
  let high = -1;
  for (let index = from; index < to; index += 1) {
    if (Number.isNaN(curve[index])) continue;
    if (low < 0 || curve[index] < curve[low]) low = index;
    if (high < 0 || curve[index] > curve[high]) high = index;
  }
  return low < 0 ? [] : [low, high];
}
