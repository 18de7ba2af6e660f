// The page of one episode: cameras, robot and curves on one clock.

import { Clock } from "./clock.js";
import { curvePane } from "./curves.js";
import { robotPane } from "./robot.js";
import { Timeline } from "./timeline.js";
import { transport } from "./transport.js";
import { Videos } from "./videos.js";

const config = JSON.parse(document.getElementById("config").textContent);
const clock = new Clock(config);
const timeline = new Timeline(clock);

new Videos([...document.querySelectorAll("video[data-camera]")], config.videos, clock);
transport(clock);
robotPane({ clock, geometry: config.geometry, poses: config.poses });
curvePane({ clock, address: config.curves, uplot: config.uplot }).then((found) => timeline.fill(found));
