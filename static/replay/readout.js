// One line about the chunk under the cursor: whose step it is, how late the chunk came, which chunks contributed.

import { t } from "../site/sentences.js";

const NAMED = 3; // chunks named at most as contributors to a step
const percent = (weight) => `${Math.round(100 * weight)} %`;
const steps = (n) => (n === 1 ? t("page.readout.step", "1 step") : t("page.readout.steps", "{n} steps", { n }));

/** Return sentences about the step at `time` as [{text, strong, warn}], the most important first. */
export function readout(chunks, time) {
  const id = chunks.ownerAt(time);
  if (id < 0) return [{ text: t("page.readout.none", "no policy output at this step") }];
  return whose(chunks, id, makers(chunks, time));
}

function whose(chunks, id, makers) {
  if (id === 0) return [{ text: t("page.readout.held", "the held target: nothing is planned here"), strong: true }, ...makers];
  const chunk = chunks.about(id);
  const name = { text: `${t("page.readout.chunk", "chunk {id}", { id })}${chunk?.strategy ? ` · ${chunk.strategy}` : ""}`, strong: true };
  if (!chunk) return [name, { text: t("page.readout.not_recorded", "its rows were not recorded") }, ...makers];
  return [name, ...delay(chunk), ...rows(chunk), ...makers, ...blend(chunk), ...inference(chunk)];
}

function delay({ delay: late, seconds, mistimed }) {
  if (late < 0) return [{ text: t("page.readout.never_arrived", "never arrived") }];
  const ms = Math.round(1000 * seconds);
  const found = [{ text: Number.isFinite(seconds) ? t("page.readout.delay_ms", "delay {steps} ({ms} ms)", { steps: steps(late), ms }) : t("page.readout.delay", "delay {steps}", { steps: steps(late) }) }];
  if (mistimed > 0) found.push({ text: t("page.readout.mistimed", "mistimed by {steps}", { steps: steps(mistimed) }), warn: true });
  return found;
}

function rows({ first, last, rows: all }) {
  return [{ text: first < 0 ? t("page.readout.no_rows", "none of {all} rows planned", { all }) : t("page.readout.rows", "rows {first} to {last} of {all}", { first, last, all }) }];
}

function blend({ overlap }) {
  return overlap > 0 ? [{ text: t("page.readout.blended", "blended in over {steps}", { steps: steps(overlap) }) }] : [];
}

function inference({ inference: ms }) {
  return Number.isFinite(ms) && ms > 0 ? [{ text: t("page.readout.inference", "policy {ms} ms", { ms: Math.round(ms) }) }] : [];
}

function makers(chunks, time) {
  const found = chunks.makersAt(time);
  if (found.length < 2) return [];
  const named = found.slice(0, NAMED).map(({ id, weight }) => (id ? t("page.readout.share", "{percent} of {id}", { percent: percent(weight), id }) : t("page.readout.share_held", "{percent} of the held target", { percent: percent(weight) })));
  const more = found.length - named.length;
  const shares = named.join(", ");
  return [{ text: more > 0 ? t("page.readout.made_of_more", "this step is {shares}, {n} more", { shares, n: more }) : t("page.readout.made_of", "this step is {shares}", { shares }) }];
}

/** Write the sentences into `element`. */
export function write(element, parts) {
  const title = parts.map(({ text }) => text).join(", ");
  if (element.title === title) return;
  element.title = title;
  element.replaceChildren(
    ...parts.map(({ text, strong, warn }) => {
      const part = document.createElement("span");
      part.className = strong ? "strong" : warn ? "warn" : "";
      part.textContent = text;
      return part;
    }),
  );
}
