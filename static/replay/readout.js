// One line about the chunk under the cursor: whose step it is, how late its chunk came, what else made it.

const NAMED = 3; // of the chunks that made a step
const percent = (weight) => `${Math.round(100 * weight)} %`;
const steps = (count) => `${count} step${count === 1 ? "" : "s"}`;

/** Sentences about the step at `time`: [{text, warn}], the most important first. */
export function readout(chunks, time) {
  const id = chunks.ownerAt(time);
  if (id < 0) return [{ text: "no policy output at this step" }];
  return whose(chunks, id, makers(chunks, time));
}

function whose(chunks, id, makers) {
  if (id === 0) return [{ text: "the held target: nothing is planned here", strong: true }, ...makers];
  const chunk = chunks.about(id);
  const name = { text: `chunk ${id}${chunk?.strategy ? ` · ${chunk.strategy}` : ""}`, strong: true };
  if (!chunk) return [name, { text: "its rows were not recorded" }, ...makers];
  return [name, ...delay(chunk), ...rows(chunk), ...makers, ...blend(chunk), ...inference(chunk)];
}

function delay({ delay: late, seconds, mistimed }) {
  if (late < 0) return [{ text: "never arrived" }];
  const found = [{ text: `delay ${steps(late)}${Number.isFinite(seconds) ? ` (${Math.round(1000 * seconds)} ms)` : ""}` }];
  if (mistimed > 0) found.push({ text: `mistimed by ${steps(mistimed)}`, warn: true });
  return found;
}

function rows({ first, last, rows: all }) {
  return [{ text: first < 0 ? `none of ${all} rows planned` : `rows ${first} to ${last} of ${all}` }];
}

function blend({ overlap }) {
  return overlap > 0 ? [{ text: `blended in over ${steps(overlap)}` }] : [];
}

function inference({ inference: ms }) {
  return Number.isFinite(ms) && ms > 0 ? [{ text: `policy ${Math.round(ms)} ms` }] : [];
}

function makers(chunks, time) {
  const found = chunks.makersAt(time);
  if (found.length < 2) return [];
  const named = found.slice(0, NAMED).map(({ id, weight }) => `${percent(weight)} of ${id || "the held target"}`);
  const more = found.length - named.length;
  return [{ text: `this step is ${named.join(", ")}${more > 0 ? `, ${more} more` : ""}` }];
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
