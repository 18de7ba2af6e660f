// Requests to our own server: the session's cookie, the CSRF token, and one sentence for whatever goes wrong.

import { sentence, t } from "./sentences.js";

const TIMEOUT_MS = 8000;

/** What the server refused, or that it did not answer; `unknown` where nobody knows whether it was done. */
export class RequestFailed extends Error {
  constructor(message, { status = 0, body = {}, unknown = false } = {}) {
    super(message);
    this.status = status;
    this.body = body;
    this.unknown = unknown;
  }
}

function token() {
  const field = document.querySelector('input[name="csrfmiddlewaretoken"]');
  return field ? field.value : "";
}

function why(status, body) {
  const words = body.reason || body.error || body.detail || body.message;
  if (typeof words === "string" && words) return sentence({ ...body, text: words });
  if (Array.isArray(words)) return words.map((one) => one.msg || String(one)).join("; ");
  if (status === 401) return t("page.api.session_ended", "your session has ended: log in again");
  return t("page.api.http", "the server answered with HTTP {status}", { status });
}

async function bodyOf(response) {
  const text = await response.text();
  try {
    return JSON.parse(text);
  } catch {
    return {};
  }
}

/**
 * Send `content` as JSON; resolves to the answer's JSON, throws RequestFailed. `simple`: without the CSRF token, as no
 * browser first asks another port whether it may.
 */
export async function post(address, content, { timeout = TIMEOUT_MS, simple = false } = {}) {
  let response;
  try {
    response = await fetch(address, {
      method: "POST",
      headers: simple ? { "Content-Type": "text/plain" } : { "Content-Type": "application/json", "X-CSRFToken": token() },
      body: JSON.stringify(content),
      credentials: "include", // also to the process for stops, at another port of ours
      redirect: "manual",
      signal: AbortSignal.timeout(timeout),
    });
  } catch (error) {
    const late = error.name === "TimeoutError";
    const what = late ? t("page.api.late", "no answer within {seconds} s: outcome unknown", { seconds: timeout / 1000 }) : t("page.api.lost", "the server cannot be reached: outcome unknown");
    throw new RequestFailed(what, { unknown: true });
  }
  if (response.type === "opaqueredirect") {
    throw new RequestFailed(t("page.api.session_ended", "your session has ended: log in again"), { status: 401 });
  }
  const body = await bodyOf(response);
  if (!response.ok) {
    const unknown = body.status === "unknown" || response.status === 504;
    throw new RequestFailed(why(response.status, body), { status: response.status, body, unknown });
  }
  return body;
}

/** The JSON at `address`; throws RequestFailed. */
export async function get(address) {
  let response;
  try {
    response = await fetch(address, { credentials: "include", signal: AbortSignal.timeout(TIMEOUT_MS) });
  } catch {
    throw new RequestFailed(t("page.api.unreachable", "the server cannot be reached"));
  }
  const body = await bodyOf(response);
  if (!response.ok) throw new RequestFailed(why(response.status, body), { status: response.status, body });
  return body;
}
