// The condition of a station's own camera in words; of cameras of the transport only the age is known.

import { formatAge } from "./labels.js";
import { t } from "../../site/sentences.js";

const WORDS = {
  opening: t("page.cameras.opening", "no picture yet"),
  lost: t("page.cameras.lost", "reconnecting"),
  ended: t("page.cameras.ended", "the video is over"),
};

/**
 * Return what is wrong with a camera as {word, reason}, or null if nothing is wrong or nothing is known. `told` is the
 * runtime's report {kind, source, condition, since, why, losses, age}, `clock` the runtime's clock [s].
 */
export function cameraProblem(told, clock) {
  if (!told || told.condition === "live") return null;
  const word = WORDS[told.condition] ?? told.condition;
  const lost = told.condition === "lost";
  return { word: lost ? t("page.cameras.lost_since", "{word}, lost {age} ago", { word, age: formatAge(Math.max(0, clock - told.since)) }) : word, reason: told.why };
}

/** Return where a camera's pictures come from, how old the newest is and how often the camera was lost. */
export function cameraSource(told) {
  const seen = told.age === null ? t("page.cameras.opening", "no picture yet") : t("page.cameras.newest", "newest picture {age} old", { age: formatAge(told.age) });
  const lost = told.losses ? told.losses === 1 ? t("page.cameras.lost_once", ", lost once") : t("page.cameras.lost_times", ", lost {n} times", { n: told.losses }) : "";
  return t("page.cameras.origin", "{kind} from {source}: {seen}{lost}", { kind: told.kind, source: told.source, seen, lost });
}

/** Return one line about all cameras: the problem of each or, if it has none, its source and age. */
export function cameraSummary(cameras, clock) {
  return Object.entries(cameras ?? {})
    .map(([name, told]) => {
      const wrong = cameraProblem(told, clock);
      return wrong ? t("page.cameras.wrong", "{name}: {word} ({why})", { name, word: wrong.word, why: wrong.reason }) : t("page.common.why", "{name}: {why}", { name, why: cameraSource(told) });
    })
    .join("; ");
}
