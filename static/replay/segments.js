// Annotations and verdicts that came along with an episode of a dataset: to be seen, not to be changed here.

import { get } from "../site/api.js";
import { bands, list, stacked } from "./review_lanes.js";

/** Fetch what lies beside the episode and show it under the time axis and in a list. */
export async function travelled(clock, address) {
  const strip = document.getElementById("segments");
  const count = document.getElementById("segments-count");
  try {
    const { segments, reviews } = await get(address);
    const placed = stacked(segments);
    strip.hidden = !segments.length;
    strip.style.setProperty("--lanes", String(1 + Math.max(0, ...placed.map(({ lane }) => lane))));
    bands(strip, placed, clock.rows, (band, segment) => {
      band.textContent = segment.label;
      band.style.setProperty("--lane", String(segment.lane));
      band.title = `${segment.label}, ${segment.by}`;
    });
    const said = segments.map(({ label, first, last, milestone, by }) => ({
      words: label,
      detail: `${first} to ${last}${milestone ? `, then ${milestone}` : ""}, ${by}`,
      go: () => clock.seekRow(first),
    }));
    const judged = [...reviews].reverse().map(({ verdict, note, by, at }) => ({ words: note ? `${verdict}: ${note}` : verdict, detail: `${by}, ${new Date(at).toLocaleString()}`, mark: verdict }));
    list(document.getElementById("segments-list"), said, "No part of it is annotated.");
    list(document.getElementById("history-list"), judged, "Nobody has said anything of it.");
    count.textContent = `Segments ${segments.length || ""}`.trim();
    document.getElementById("history-count").textContent = `Verdicts ${reviews.length || ""}`.trim();
  } catch (error) {
    count.textContent = "No segments";
    count.title = error.message;
  }
}
