// Texts of the pages in the language chosen in this browser, looked up by id; English if none is chosen. Nothing waits for a
// catalogue: the one that the last page used is kept in this browser, and when a newer one has arrived, the event
// "eva:language" is sent to the document.

const COOKIE = "eva_language";
const KEPT = "eva-language"; // {code, sentences} that the last page used
const PART = /\{\{|\}\}|\{([a-z][a-z0-9_]*)(!r)?(?::([^{}]*))?\}/g;

const root = globalThis.document?.documentElement; // undefined in tests, which have no document
let patterns = {};

/** Use these patterns (id -> pattern) from now on; {} means English. */
export function speak(found) {
  patterns = found;
  if (root) document.dispatchEvent(new Event("eva:language"));
}

/**
 * Return the text of {id, arguments, text} in the chosen language, or its English `text` if the language has no pattern for it.
 */
export function sentence({ id = "", arguments: given = {}, text = "" }) {
  return Object.hasOwn(patterns, id) ? filled(patterns[id], given) ?? text : text;
}

/** Return a text of the page: `english` with its {names} replaced by `given`, or the text of the chosen language. */
export function t(id, english, given = {}) {
  return sentence({ id, arguments: given, text: filled(english, given) ?? english });
}

/** Return a pattern with its names replaced by `given`, or null if it uses a name that is not given. */
function filled(pattern, given) {
  let whole = true;
  const said = pattern.replace(PART, (part, name, quoted, spec = "") => {
    if (part === "{{" || part === "}}") return part[0];
    if (!Object.hasOwn(given, name)) whole = false;
    return whole ? shown(given[name], quoted, spec) : "";
  });
  return whole ? said : null;
}

/** Return a message whose `reason` is in the chosen language; the message also has the id and arguments of its reason. */
export function reasoned(message) {
  return typeof message.reason === "string" ? { ...message, reason: sentence({ ...message, text: message.reason }) } : message;
}

/**
 * Return a station's snapshot with its texts in the chosen language; its "sentences" maps the path of each such text to its
 * sentence.
 */
export function localized(snapshot) {
  const said = snapshot?.sentences ?? {};
  const found = Object.entries(said).filter(([, { id }]) => Object.hasOwn(patterns, id));
  if (!found.length) return snapshot;
  const copy = structuredClone(snapshot);
  for (const [path, one] of found) put(copy, path, one);
  return copy;
}

/** Replace the text at `path`: keys joined by dots, where the keys may contain dots themselves. */
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

/** Format a number as Python does, for ".2f", "g", ".3g" and "d"; any other format prints it unchanged. */
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
    load(target.value).then(() => location.reload()); // the page keeps its lease
  });
}
