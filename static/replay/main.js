// The page of one episode: cameras, robot and curves on one clock. The pictures are loaded first, robot and curves after them.

import { t } from "../site/sentences.js";
import { cameras, firstPictures } from "./cameras.js";
import { Clock } from "./clock.js";
import { enlarged } from "./enlarged.js";
import { Review } from "./review.js";
import { showRecordedSegments } from "./segments.js";
import { Timeline } from "./timeline.js";
import { transport } from "./transport.js";

const config = JSON.parse(document.getElementById("config").textContent);
const clock = new Clock(config);
const timeline = new Timeline(clock, { videos: config.videos, grid: config.grid });

/** Show in a pane's note why its scripts could not be loaded. */
function absent(note, error) {
  document.getElementById(note).textContent = t("page.replay.not_loaded", "The scripts of this pane did not load: {why}. Load the page again.", { why: error.message });
  console.error(error);
}

cameras(document, config.videos, clock);
enlarged(document.getElementById("cameras"));
transport(clock);
if (document.getElementById("review")) new Review(clock);
if (config.segments) showRecordedSegments(clock, config.segments);
await firstPictures(document);
import("./curves.js")
  .then(({ curvePane }) => curvePane({ clock, address: config.curves, uplot: config.uplot }))
  .then((found) => timeline.fill(found))
  .catch((error) => absent("curves-note", error));
import("./robot.js")
  .then(({ robotPane }) => robotPane({ root: document, clock, viewer: config.viewer, geometry: config.geometry, poses: config.poses, bench: config.bench, why: config.why }))
  .catch((error) => absent("scene-note", error));
