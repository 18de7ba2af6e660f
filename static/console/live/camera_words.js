// How a camera of the station's own is, in words; those of the transport say no more than their age.

import { age } from "./words.js";

const WORDS = {
  opening: "no picture yet",
  lost: "reconnecting",
  ended: "the video is over",
};

/**
 * What is wrong with a camera, as the runtime tells it ({kind, source, condition, since, why, losses, age}) at
 * `clock` of the runtime [s]: {word, reason}, or null where nothing is, or nothing is told.
 */
export function trouble(told, clock) {
  if (!told || told.condition === "live") return null;
  const word = WORDS[told.condition] ?? told.condition;
  const lasts = told.condition === "lost" ? `, lost ${age(Math.max(0, clock - told.since))} ago` : "";
  return { word: word + lasts, reason: told.why };
}

/** Where its pictures come from, how old the newest is and how often it was lost. */
export function origin(told) {
  const seen = told.age === null ? "no picture yet" : `newest picture ${age(told.age)} old`;
  const lost = told.losses ? `, lost ${told.losses === 1 ? "once" : `${told.losses} times`}` : "";
  return `${told.kind} from ${told.source}: ${seen}${lost}`;
}

/** All of them in a line: each with its trouble, or its age. */
export function summary(cameras, clock) {
  return Object.entries(cameras ?? {})
    .map(([name, told]) => {
      const wrong = trouble(told, clock);
      return wrong ? `${name}: ${wrong.word} (${wrong.reason})` : `${name}: ${origin(told)}`;
    })
    .join("; ");
}
