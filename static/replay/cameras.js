// The cameras of an episode on one clock, as videos or as single pictures.

import { Stills } from "./stills.js";
import { Videos } from "./videos.js";

const LONGEST_MS = 2000; // longest time for which anything waits for pictures
const LOOK_MS = 10;

/** Show `videos` ({camera, address, start, pictures}) in the elements with data-camera below `root`. */
export function cameras(root, videos, clock) {
  const placed = videos.map((video) => ({ ...video, element: root.querySelector(`[data-camera="${CSS.escape(video.camera)}"]`) }));
  new Videos(placed.filter(({ pictures }) => !pictures), clock);
  new Stills(placed.filter(({ pictures }) => pictures), clock);
}

/** Resolve when all cameras below `root` show a picture or have failed, or after LONGEST_MS. */
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
  if (element.tagName === "IMG") return element.complete && element.hasAttribute("src"); // true for failed images too
  return element.error !== null || (element.readyState >= HTMLMediaElement.HAVE_CURRENT_DATA && !element.seeking);
}
