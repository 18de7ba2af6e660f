// Says in the picture of a camera that it is not the picture of the row, because that is missing from the video.

import { t } from "../site/sentences.js";

const WORDS = {
  lost: () => t("page.replay.lost", "lost: the one before"),
  video_lost: ({ first }) => (first > 0 ? t("page.replay.video_ended", "ended at row {row}", { row: first }) : t("page.replay.no_video", "no video")),
};

/** Return what to say about a camera at a row, from the flags of the checks; "" if its picture is that of the row. */
export function lostFrameText(flags, camera, row) {
  const flag = flags.find(({ kind, stream, first, last }) => kind in WORDS && stream === camera && first <= row && row <= last);
  return flag ? WORDS[flag.kind](flag) : "";
}

/** Show these texts beside the names of the cameras on the page. */
export function showLostFrames(flags, row) {
  for (const picture of document.querySelectorAll("[data-camera]")) {
    const words = lostFrameText(flags, picture.dataset.camera, row);
    const place = picture.parentElement.querySelector("[data-lost]");
    if (place.textContent !== words) place.textContent = words;
    picture.toggleAttribute("data-stands", Boolean(words));
  }
}
