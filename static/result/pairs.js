// The last picture of each trial of a comparison, loaded when it comes into view.

import { Clips } from "./clips.js";

new Clips(document.querySelectorAll(".pair-side video"));
