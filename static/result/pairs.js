// The last picture of each trial of a comparison, as it comes into view.

import { Clips } from "./clips.js";

new Clips(document.querySelectorAll(".pair-side video"));
