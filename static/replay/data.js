// The binary messages of an episode.

import { decode } from "../console/frame.js";

/** The message at `address`; throws with the server's sentence. */
export async function message(address) {
  const response = await fetch(address, { credentials: "same-origin", redirect: "manual", headers: { Accept: "application/json" } });
  if (response.ok) return decode(await response.arrayBuffer());
  if (response.type === "opaqueredirect") throw new Error("your session has ended: log in again");
  const said = await response.json().catch(() => ({}));
  throw new Error(said.error ?? `the server answered with HTTP ${response.status}`);
}

/** The last index whose value in the ascending `values` is not above `value`, -1 where there is none. */
export function last(values, value) {
  let low = 0;
  let high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Joint j of an array that lies joint by joint; nothing is copied. */
export function joint(values, index, length) {
  return values.subarray(index * length, (index + 1) * length);
}
