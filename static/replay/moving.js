// Which joints move most: what an episode is about is seen in them.

const AS_FAR = { m: 10 }; // of a joint of that unit one counts as so many radians: a gripper that closes is a motion

/** The joints of `count` [indices], those that move farthest first; `values` lie joint by joint, `units` say of what. */
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
