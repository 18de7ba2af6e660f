// The cameras of an episode, as videos or as single pictures, on one clock.

import { Stills } from "./stills.js";
import { Videos } from "./videos.js";

const LONGEST_MS = 2000; // that anything else waits for pictures
const LOOK_MS = 10;

/** Let the elements with data-camera below `root` show `videos` ({camera, address, start, pictures}). */
export function cameras(root, videos, clock) {
  const placed = videos.map((video) => ({ ...video, element: root.querySelector(`[data-camera="${CSS.escape(video.camera)}"]`) }));
  new Videos(placed.filter(({ pictures }) => !pictures), clock);
  new Stills(placed.filter(({ pictures }) => pictures), clock);
}

/** Resolves when all cameras below `root` show a picture, cannot, or have been waited for long enough. */
export function firstPictures(root) {
  const all = [...root.querySelectorAll("[data-camera]")];
  const begun = performance.now();
  return new Promise((resolve) => {
    const look = () => {
      if (performance.now() - begun > LONGEST_MS || all.every(settled)) resolve();
      else setTimeout(look, LOOK_MS);
    };
    look();
  });
}

function settled(element) {
  if (element.tagName === "IMG") return element.complete && element.hasAttribute("src"); // failed ones too
  return element.error !== null || (element.readyState >= HTMLMediaElement.HAVE_CURRENT_DATA && !element.seeking);
}
