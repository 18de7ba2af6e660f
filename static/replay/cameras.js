// The cameras of an episode, as videos or as single pictures, on one clock.

import { Stills } from "./stills.js";
import { Videos } from "./videos.js";

/** Let the elements with data-camera below `root` show `videos` ({camera, address, start, pictures}). */
export function cameras(root, videos, clock) {
  const placed = videos.map((video) => ({ ...video, element: root.querySelector(`[data-camera="${CSS.escape(video.camera)}"]`) }));
  new Videos(placed.filter(({ pictures }) => !pictures), clock);
  new Stills(placed.filter(({ pictures }) => pictures), clock);
}
