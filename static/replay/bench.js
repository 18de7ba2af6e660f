// The objects on a simulated bench at the row of the clock, drawn in the scene as on the station's pages.

import { get } from "../site/api.js";
import { lastNotAbove } from "../site/binary_search.js";

/** Draw the bench's course from `address` in `scene`; do nothing if none was recorded. */
export async function followBench(scene, clock, address) {
  const { course } = await get(address);
  if (!course.length) return;
  const rows = course.map(({ row }) => row);
  const show = () => scene.setBench(course[Math.max(0, lastNotAbove(rows, clock.row))]);
  for (const kind of ["tick", "seek"]) clock.addEventListener(kind, show);
  show();
}
