// Requests to the server. Every failure becomes an ApiError whose message is shown to the operator.

import { emit, state } from "./state.js";
import { hasText, t } from "../texts.js";

export class ApiError extends Error {
  constructor(status, code, message, body = {}, retry_after_s = 0) {
    super(message);
    this.status = status;
    this.code = code;
    this.body = body;
    this.retry_after_s = retry_after_s;
  }
}

/** The error of a response, in the language of the page. A response of a proxy has no code of the server. */
async function errorOf(response) {
  const body = await response.json().catch(() => ({}));
  const retry_after_s = Number(response.headers.get("Retry-After")) || 0;
  const busy = response.status === 429 || response.status === 503;
  const { status } = response;
  const text = !busy ? t("api.status", { status }) : retry_after_s ? t("api.busy_for", { status, seconds: retry_after_s }) : t("api.busy", { status });
  const { code = "error", field = null, message = "" } = body.error ?? {};
  const name = [`error.${code}.${field}`, `error.${code}${busy && retry_after_s ? "_for" : ""}`, `error.${code}`].find(hasText);
  return new ApiError(status, code, name ? t(name, { message, seconds: retry_after_s }) : text, body, retry_after_s);
}

let csrf = "";
export const setToken = (token) => { csrf = token; };

/** Send a request, and return what `read` reads of its response, which can be cut, by a reload, too. `lost`: text of this case. */
async function send(path, read, options = {}, lost = "api.no_response") {
  let response, content;
  try {
    response = await fetch(path, { credentials: "same-origin", cache: "no-store", redirect: "error", ...options });
    if (response.ok) content = await read(response);
  } catch (error) {
    throw new ApiError(0, "no_connection", t(lost), { cause: String(error) });
  }
  if (response.ok) return content;
  if (response.status === 401 && !path.startsWith("/api/login")) location.assign("/login?ended");
  throw await errorOf(response);
}

async function request(method, path, body) {
  const headers = { Accept: "application/json" };
  const options = { method, headers, signal: AbortSignal.timeout(15000) };
  if (method !== "GET") {
    Object.assign(headers, { "Content-Type": "application/json", "X-CSRF-Token": csrf });
    options.body = JSON.stringify(body ?? {});
  }
  const content = await send(path, (response) => (response.status === 204 ? null : response.json()), options);
  // Without events, the page does not receive the change that it has made.
  if (method !== "GET" && !state.online) emit("reload");
  return content;
}

/** Download a file. The server prepares exports one at a time, so that the response may take minutes. */
const download = (path) => send(path, (response) => response.blob(), {}, "api.interrupted");

/** Load an image: its file, and its digest, which is null for a mask. */
const image = (path, cache) => send(path, async (response) => ({ file: await response.blob(), sha256: response.headers.get("X-Image-SHA256") }), { cache });

/** A load that is called again: the answer to an earlier call that arrives after that to a later one is the later one. */
export function inOrder(load) {
  let sent = 0;
  let newest = { number: 0, answer: null };
  return async () => {
    const number = (sent += 1);
    const answer = await load();
    if (number > newest.number) newest = { number, answer };
    return newest.answer;
  };
}

/** Return why the event stream is refused; null if it is accepted. */
async function streamError(path) {
  const ended = new AbortController();
  try {
    const response = await fetch(path, { credentials: "same-origin", cache: "no-store", signal: ended.signal });
    return response.ok ? null : await errorOf(response);
  } catch {
    return null; // no connection: the stream reconnects
  } finally {
    ended.abort();
  }
}

const contactPath = (id) => `/api/contacts/${encodeURIComponent(id)}`;
const objectPath = (id) => `/api/objects/${encodeURIComponent(id)}`;
const queryString = (values) => {
  const parts = Object.entries(values).filter(([, value]) => value !== "" && value !== null && value !== undefined);
  return new URLSearchParams(parts).toString();
};

export const api = {
  login: (user, password) => request("POST", "/api/login", { user, password }),
  logout: () => request("POST", "/api/logout"),
  password: (old, replacement) => request("POST", "/api/password", { old, new: replacement }),
  loginLink: (token) => request("POST", "/api/login-link", { token }),
  settings: () => request("GET", "/api/settings"),
  storeSettings: (settings) => request("POST", "/api/settings", { settings }),
  session: () => request("GET", "/api/session"),
  info: () => request("GET", "/api/info"),
  contacts: (values) => request("GET", `/api/contacts?${queryString(values)}`),
  contact: (id) => /** @type {Promise<ContactDetail>} */ (request("GET", contactPath(id))),
  measure: (id, body) => request("POST", `${contactPath(id)}/measure`, body),
  withdrawMeasurement: (id, measurement) => request("POST", `${contactPath(id)}/measure/${measurement}/withdraw`),
  decide: (id, body) => request("POST", `${contactPath(id)}/decisions`, body),
  lastDecision: () => request("GET", "/api/decisions/last"),
  notices: () => request("GET", "/api/notices"),
  acknowledge: (notice) => request("POST", `/api/notices/${notice}/acknowledge`),
  undo: (id, body) => request("POST", `${contactPath(id)}/undo`, body),
  object: (id) => request("GET", objectPath(id)),
  decideObject: (id, body) => request("POST", `${objectPath(id)}/decisions`, body),
  splitLook: (id, contact) => request("POST", `${objectPath(id)}/split`, { contact }),
  mergeObjects: (id, contact) => request("POST", `${objectPath(id)}/merge`, { contact }),
  request: (id, body) => request("POST", `${contactPath(id)}/requests`, body),
  comment: (id, body) => request("POST", `${contactPath(id)}/comment`, body),
  fleet: () => request("GET", "/api/fleet"),
  score: () => request("GET", "/api/score"),
  map: () => request("GET", "/api/map"),
  tracks: () => request("GET", "/api/map/tracks"),
  export: (format, filter) => download(`/api/export/contacts.${format}?${queryString(filter)}`),
  exportProgress: () => request("GET", "/api/export"),
  cancelExport: () => request("POST", "/api/export/cancel"),
  sheetsUrl: (filter) => `/report?${queryString(filter)}`,
  streamError,
  image,
  reportUrl: (id) => `/report/${encodeURIComponent(id)}`,
  imageUrl: (id, version) => `${contactPath(id)}/versions/${version}/image.png`,
  maskUrl: (id, version) => `${contactPath(id)}/versions/${version}/mask.png`,
  thumbnailUrl: (id, version) => `${contactPath(id)}/versions/${version}/thumbnail.png`,
};
