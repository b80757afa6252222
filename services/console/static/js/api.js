// The server: one function a request. Every failure becomes an ApiError that says what to tell the operator.

export class ApiError extends Error {
  constructor(status, code, message, body = {}) {
    super(message);
    this.status = status;
    this.code = code;
    this.body = body;
  }
}

let csrf = "";
export const useToken = (token) => { csrf = token; };

async function request(method, path, body) {
  const headers = { Accept: "application/json" };
  if (method !== "GET") {
    headers["Content-Type"] = "application/json";
    headers["X-CSRF-Token"] = csrf;
  }
  let response;
  try {
    response = await fetch(path, {
      method, headers, credentials: "same-origin", cache: "no-store", redirect: "error",
      body: method === "GET" ? undefined : JSON.stringify(body ?? {}), signal: AbortSignal.timeout(15000),
    });
  } catch (error) {
    throw new ApiError(0, "no_connection", "The console's server does not answer.", { cause: String(error) });
  }
  if (response.status === 204) return null;
  const answer = await response.json().catch(() => ({}));
  if (response.ok) return answer;
  if (response.status === 401 && path !== "/api/login") location.assign("/login");
  const { code = "error", message = `The server answered ${response.status}.` } = answer.error ?? {};
  throw new ApiError(response.status, code, message, answer);
}

const of = (id) => `/api/contacts/${encodeURIComponent(id)}`;
const query = (values) => {
  const parts = Object.entries(values).filter(([, value]) => value !== "" && value !== null && value !== undefined);
  return new URLSearchParams(parts).toString();
};

export const api = {
  login: (user, password) => request("POST", "/api/login", { user, password }),
  logout: () => request("POST", "/api/logout"),
  password: (old, fresh) => request("POST", "/api/password", { old, new: fresh }),
  session: () => request("GET", "/api/session"),
  info: () => request("GET", "/api/info"),
  contacts: (values) => request("GET", `/api/contacts?${query(values)}`),
  contact: (id) => request("GET", of(id)),
  measure: (id, body) => request("POST", `${of(id)}/measure`, body),
  decide: (id, body) => request("POST", `${of(id)}/decisions`, body),
  undo: (id, body) => request("POST", `${of(id)}/undo`, body),
  costs: (id) => request("GET", `${of(id)}/costs`),
  request: (id, body) => request("POST", `${of(id)}/requests`, body),
  advise: (id, body) => request("POST", `${of(id)}/advice`, body),
  fleet: () => request("GET", "/api/fleet"),
  map: () => request("GET", "/api/map"),
  exportUrl: (format, filter) => `/api/export/contacts.${format}?${query(filter)}`,
  reportUrl: (id) => `/report/${encodeURIComponent(id)}`,
  pictureUrl: (id, version, layer) => `${of(id)}/versions/${version}/picture.png?${query({ layer, map: "grey" })}`,
  maskUrl: (id, version, kind, layer) => `${of(id)}/versions/${version}/mask.png?${query({ kind, layer })}`,
  thumbnailUrl: (id, version) => `${of(id)}/versions/${version}/thumbnail.png`,
};
