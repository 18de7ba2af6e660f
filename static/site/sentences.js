// Words of the pages in the language that this browser has chosen: by their ids, English without one. Nothing waits for a
// catalogue: the one of the last page is kept in this browser; when a newer one has come, "eva:language" is told to the
// document.

const COOKIE = "eva_language";
const KEPT = "eva-language"; // {code, sentences}, as the last page had them
const PART = /\{\{|\}\}|\{([a-z][a-z0-9_]*)(!r)?(?::([^{}]*))?\}/g;

const root = globalThis.document?.documentElement; // none where tests run it
let patterns = {};

/** Speak by these patterns (id -> pattern) from now on; {} is English. */
export function speak(found) {
  patterns = found;
  if (root) document.dispatchEvent(new Event("eva:language"));
}

/** What {id, arguments, text} says: in the chosen language where that has words for it, else its text. */
export function sentence({ id = "", arguments: given = {}, text = "" }) {
  return Object.hasOwn(patterns, id) ? filled(patterns[id], given) ?? text : text;
}

/** A text of the page: its English, in which {names} stand for what is given, or the words of the chosen language. */
export function t(id, english, given = {}) {
  return sentence({ id, arguments: given, text: filled(english, given) ?? english });
}

/** A pattern with what is given; null where it asks for what there is not. */
function filled(pattern, given) {
  let whole = true;
  const said = pattern.replace(PART, (part, name, quoted, spec = "") => {
    if (part === "{{" || part === "}}") return part[0];
    if (!Object.hasOwn(given, name)) whole = false;
    return whole ? shown(given[name], quoted, spec) : "";
  });
  return whole ? said : null;
}

/** A message with `reason` and the id and arguments of that, with what it says in the chosen language. */
export function reasoned(message) {
  return typeof message.reason === "string" ? { ...message, reason: sentence({ ...message, text: message.reason }) } : message;
}

/** The snapshot of a station with its texts in the chosen language: those that its "sentences" name, by where they stand. */
export function localized(snapshot) {
  const said = snapshot?.sentences ?? {};
  const found = Object.entries(said).filter(([, { id }]) => Object.hasOwn(patterns, id));
  if (!found.length) return snapshot;
  const copy = structuredClone(snapshot);
  for (const [path, one] of found) put(copy, path, one);
  return copy;
}

/** Replace the text at `path`, keys with dots between them, which keys may have themselves. */
function put(tree, path, one) {
  if (tree === null || typeof tree !== "object") return;
  if (typeof tree[path] === "string") {
    tree[path] = sentence({ ...one, text: tree[path] });
    return;
  }
  for (const key of Object.keys(tree)) {
    if (path.startsWith(`${key}.`)) put(tree[key], path.slice(key.length + 1), one);
  }
}

function shown(value, quoted, spec) {
  if (typeof value === "number") return quoted ? String(value) : figure(value, spec);
  const text = typeof value === "object" && value !== null ? sentence(value) : String(value);
  const said = quoted ? `'${text.replaceAll("\\", "\\\\").replaceAll("'", "\\'")}'` : text;
  return /^\.\d+$/.test(spec) ? [...said].slice(0, Number(spec.slice(1))).join("") : said;
}

/** As Python formats it: ".2f", "g", ".3g", "d"; anything else leaves it as it is. */
function figure(value, spec) {
  const [, digits, kind] = /^(?:\.(\d+))?([fgd])$/.exec(spec) ?? [];
  if (kind === "f") return value.toFixed(digits ?? 6);
  if (kind === "g") return String(Number(value.toPrecision(digits ?? 6)));
  return String(value);
}

async function load(code) {
  const address = root.dataset.languages;
  if (!code || !address) return speak({});
  const kept = JSON.parse(localStorage.getItem(KEPT) ?? "{}");
  if (kept.code === code && kept.sentences) speak(kept.sentences);
  try {
    const answer = await fetch(address.replace("_", code), { credentials: "same-origin" });
    if (!answer.ok) return;
    const { sentences } = await answer.json();
    speak(sentences);
    localStorage.setItem(KEPT, JSON.stringify({ code, sentences }));
  } catch (error) {
    console.error(`the language ${code} did not come: ${error.message}`);
  }
}

if (root) {
  load(root.dataset.language);
  document.addEventListener("change", ({ target }) => {
    if (!target.matches("[data-language-choice]")) return;
    document.cookie = `${COOKIE}=${target.value}; path=/; max-age=31536000; samesite=lax`;
    load(target.value).then(() => location.reload()); // it keeps its lease
  });
}
