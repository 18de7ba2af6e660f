// The page of one episode: cameras, robot and curves on one clock.

import { cameras } from "./cameras.js";
import { Clock } from "./clock.js";
import { curvePane } from "./curves.js";
import { Review } from "./review.js";
import { robotPane } from "./robot.js";
import { travelled } from "./segments.js";
import { Timeline } from "./timeline.js";
import { transport } from "./transport.js";

const config = JSON.parse(document.getElementById("config").textContent);
const clock = new Clock(config);
const timeline = new Timeline(clock);

cameras(document, config.videos, clock);
transport(clock);
if (document.getElementById("review")) new Review(clock);
if (config.segments) travelled(clock, config.segments);
robotPane({ root: document, clock, geometry: config.geometry, poses: config.poses, why: config.why });
curvePane({ clock, address: config.curves, uplot: config.uplot }).then((found) => timeline.fill(found));
