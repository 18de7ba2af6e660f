// Which cameras show another picture than the one of the row, said where the picture is: it was given, and is not in the video.

import { t } from "../site/sentences.js";

const WORDS = {
  lost: () => t("page.replay.lost", "lost: the one before"),
  video_lost: ({ first }) => (first > 0 ? t("page.replay.video_ended", "ended at row {row}", { row: first }) : t("page.replay.no_video", "no video")),
};

/** What is to be said of a camera at a row by the flags of the checks; "" where its picture is that of the row. */
export function lostFrameText(flags, camera, row) {
  const flag = flags.find(({ kind, stream, first, last }) => kind in WORDS && stream === camera && first <= row && row <= last);
  return flag ? WORDS[flag.kind](flag) : "";
}

/** Say it beside the names of the cameras on the page. */
export function showLostFrames(flags, row) {
  for (const picture of document.querySelectorAll("[data-camera]")) {
    const words = lostFrameText(flags, picture.dataset.camera, row);
    const place = picture.parentElement.querySelector("[data-lost]");
    if (place.textContent !== words) place.textContent = words;
    picture.toggleAttribute("data-stands", Boolean(words));
  }
}
