// Binary messages about an episode.

import { decode } from "../console/live/frame.js";
import { sentence, t } from "../site/sentences.js";

/** Resolve to the decoded message at `address`; throw an error with the server's sentence. */
export async function message(address) {
  const response = await fetch(address, { credentials: "same-origin", redirect: "manual", headers: { Accept: "application/json" } });
  if (response.ok) return decode(await response.arrayBuffer());
  if (response.type === "opaqueredirect") throw new Error(t("page.site.session_ended", "your session has ended: log in again"));
  const said = await response.json().catch(() => ({}));
  if (said.error) throw new Error(sentence({ ...said, text: said.error }));
  throw new Error(t("page.site.http_status", "the server answered with HTTP {status}", { status: response.status }));
}

/** Return one joint of an array that is ordered joint by joint; nothing is copied. */
export function joint(values, index, length) {
  return values.subarray(index * length, (index + 1) * length);
}
