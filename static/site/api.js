// Requests to the server of this site, with the session's cookie and the CSRF token; every failure becomes one sentence.

import { sentence, t } from "./sentences.js";

const TIMEOUT_MS = 8000;

/** A request that the server refused or did not answer; `unknown` is true if nobody knows whether it was carried out. */
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
 * Send `content` as JSON and resolve to the JSON of the answer; throw RequestFailed on any failure. With `simple`, send it as
 * plain text without the CSRF token, so that the browser sends no preflight request before it posts to another port.
 */
export async function post(address, content, { timeout = TIMEOUT_MS, simple = false } = {}) {
  let response;
  try {
    response = await fetch(address, {
      method: "POST",
      headers: simple ? { "Content-Type": "text/plain" } : { "Content-Type": "application/json", "X-CSRFToken": token() },
      body: JSON.stringify(content),
      credentials: "include", // the process for stops, on another port of this host, needs the cookie too
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

/** Return the JSON at `address`; throw RequestFailed on any failure. */
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
