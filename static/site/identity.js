// Unique identifiers. `crypto.randomUUID` exists only on secure origins, and a lab often uses plain HTTP.

function hex(count) {
  const bytes = crypto.getRandomValues(new Uint8Array(count));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Return a random UUID (version 4). */
export function uuid() {
  const digits = [...hex(16)];
  digits[12] = "4";
  digits[16] = "89ab"[parseInt(digits[16], 16) & 3];
  const text = digits.join("");
  return [text.slice(0, 8), text.slice(8, 12), text.slice(12, 16), text.slice(16, 20), text.slice(20)].join("-");
}

const KEY = "eva-page";
const ASK_MS = 120;

/**
 * Return the identifier of this page. It stays the same after a reload, so that the page keeps its lease; a duplicated tab gets
 * another one, so that two pages never command as one.
 */
export async function pageId() {
  const channel = new BroadcastChannel("eva-pages");
  const self = hex(8); // identifies this document
  let id = sessionStorage.getItem(KEY) || hex(8);
  const taken = new Promise((resolve) => {
    channel.addEventListener("message", ({ data }) => {
      if (data.asked === id && data.by !== self) channel.postMessage({ taken: data.asked });
      if (data.taken === id) resolve(true);
    });
    setTimeout(() => resolve(false), ASK_MS);
  });
  channel.postMessage({ asked: id, by: self });
  if (await taken) id = hex(8);
  sessionStorage.setItem(KEY, id);
  return id;
}
