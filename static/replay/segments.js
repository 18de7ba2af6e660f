// Annotations and verdicts that came along with an episode of a dataset: to be seen, not to be changed here.

import { get } from "../site/api.js";
import { when } from "../site/times.js";
import { list } from "./review_lanes.js";
import { SegmentLane } from "./segment_lane.js";

/** Fetch what lies beside the episode and show it under the time axis and in a list. */
export async function travelled(clock, address) {
  const strip = document.getElementById("segments");
  const count = document.getElementById("segments-count");
  try {
    const { segments, reviews } = await get(address);
    strip.hidden = !segments.length;
    new SegmentLane({ strip, clock }).show(segments.map((segment) => ({ ...segment, annotator: segment.by })));
    const said = segments.map(({ label, first, last, milestone, by }) => ({
      words: label,
      detail: `${first} to ${last}${milestone ? `, then ${milestone}` : ""}, ${by}`,
      go: () => clock.seekRow(first),
    }));
    const judged = [...reviews].reverse().map(({ verdict, note, by, at }) => ({ words: note ? `${verdict}: ${note}` : verdict, detail: `${by}, ${when(at)}`, mark: verdict }));
    list(document.getElementById("segments-list"), said, "No segment is annotated.");
    list(document.getElementById("history-list"), judged, "No review.");
    count.textContent = `Segments ${segments.length || ""}`.trim();
    document.getElementById("history-count").textContent = `Verdicts ${reviews.length || ""}`.trim();
  } catch (error) {
    count.textContent = "No segments";
    count.title = error.message;
  }
}
