// Which joints move most; these show best what happens in an episode.

const AS_FAR = { m: 10 }; // how many radians one unit of a joint counts as, so that closing a gripper counts as a motion

/**
 * Return the indices of the `count` joints, those that move farthest first. `values` are ordered joint by joint; `units` are
 * the joints' units.
 */
export function movingMost(values, count, units) {
  const length = values.length / count;
  const moved = Array.from({ length: count }, (_, index) => {
    let low = Infinity;
    let high = -Infinity;
    for (const value of values.subarray(index * length, (index + 1) * length)) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    return high > low ? (high - low) * (AS_FAR[units[index]] ?? 1) : 0;
  });
  return [...moved.keys()].sort((one, other) => moved[other] - moved[one] || one - other);
}
