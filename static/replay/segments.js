// Segments and verdicts that belong to an episode of a dataset; here they are only shown.

import { get } from "../site/api.js";
import { t } from "../site/sentences.js";
import { when } from "../site/times.js";
import { fillList, span, verdictWord } from "./review_lanes.js";
import { SegmentLane } from "./segment_lane.js";

/** Fetch the annotations of the episode, and show them under the time axis and in lists. */
export async function showRecordedSegments(clock, address) {
  const strip = document.getElementById("segments");
  const count = document.getElementById("segments-count");
  try {
    const { segments, reviews } = await get(address);
    strip.hidden = !segments.length;
    new SegmentLane({ strip, clock }).show(segments.map((segment) => ({ ...segment, annotator: segment.by })));
    const said = segments.map(({ label, first, last, milestone, by }) => ({
      words: label,
      detail: span({ first, last, milestone }, by),
      go: () => clock.seekRow(first),
    }));
    const judged = [...reviews].reverse().map(({ verdict, note, by, at }) => ({ words: note ? `${verdictWord(verdict)}: ${note}` : verdictWord(verdict), detail: `${by}, ${when(at)}`, mark: verdict }));
    fillList(document.getElementById("segments-list"), said, t("page.review.no_segments", "No segment is annotated."));
    fillList(document.getElementById("history-list"), judged, t("page.review.no_reviews", "No review."));
    count.textContent = segments.length ? t("page.review.segments_n", "Segments {n}", { n: segments.length }) : t("page.review.segments", "Segments");
    document.getElementById("history-count").textContent = reviews.length ? t("page.review.verdicts_n", "Verdicts {n}", { n: reviews.length }) : t("page.review.verdicts", "Verdicts");
  } catch (error) {
    count.textContent = t("page.review.segments_none", "No segments");
    count.title = error.message;
  }
}
