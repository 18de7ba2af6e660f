// How a camera of the station's own is, in words; those of the transport say no more than their age.

import { formatAge } from "./labels.js";
import { t } from "../../site/sentences.js";

const WORDS = {
  opening: t("page.cameras.opening", "no picture yet"),
  lost: t("page.cameras.lost", "reconnecting"),
  ended: t("page.cameras.ended", "the video is over"),
};

/**
 * What is wrong with a camera, as the runtime tells it ({kind, source, condition, since, why, losses, age}) at
 * `clock` of the runtime [s]: {word, reason}, or null where nothing is, or nothing is told.
 */
export function cameraProblem(told, clock) {
  if (!told || told.condition === "live") return null;
  const word = WORDS[told.condition] ?? told.condition;
  const lost = told.condition === "lost";
  return { word: lost ? t("page.cameras.lost_since", "{word}, lost {age} ago", { word, age: formatAge(Math.max(0, clock - told.since)) }) : word, reason: told.why };
}

/** Where its pictures come from, how old the newest is and how often it was lost. */
export function cameraSource(told) {
  const seen = told.age === null ? t("page.cameras.opening", "no picture yet") : t("page.cameras.newest", "newest picture {age} old", { age: formatAge(told.age) });
  const lost = told.losses ? told.losses === 1 ? t("page.cameras.lost_once", ", lost once") : t("page.cameras.lost_times", ", lost {n} times", { n: told.losses }) : "";
  return t("page.cameras.origin", "{kind} from {source}: {seen}{lost}", { kind: told.kind, source: told.source, seen, lost });
}

/** All of them in a line: each with its trouble, or its age. */
export function cameraSummary(cameras, clock) {
  return Object.entries(cameras ?? {})
    .map(([name, told]) => {
      const wrong = cameraProblem(told, clock);
      return wrong ? t("page.cameras.wrong", "{name}: {word} ({why})", { name, word: wrong.word, why: wrong.reason }) : t("page.common.why", "{name}: {why}", { name, why: cameraSource(told) });
    })
    .join("; ");
}
