// The things on a simulated bench, where they lay at the row of the clock; drawn by the scene as on the station's pages.

import { get } from "../site/api.js";
import { lastNotAbove } from "../site/binary_search.js";

/** Draw in `scene` what `address` says of the bench; nothing where it says nothing. */
export async function followBench(scene, clock, address) {
  const { course } = await get(address);
  if (!course.length) return;
  const rows = course.map(({ row }) => row);
  const show = () => scene.setBench(course[Math.max(0, lastNotAbove(rows, clock.row))]);
  for (const kind of ["tick", "seek"]) clock.addEventListener(kind, show);
  show();
}
