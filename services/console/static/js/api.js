// Requests to the server. Every failure becomes an ApiError whose message is shown to the operator.

export class ApiError extends Error {
  constructor(status, code, message, body = {}) {
    super(message);
    this.status = status;
    this.code = code;
    this.body = body;
  }
}

let csrf = "";
export const setToken = (token) => { csrf = token; };

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
    throw new ApiError(0, "no_connection", "No response from the console's server.", { cause: String(error) });
  }
  if (response.status === 204) return null;
  const result = await response.json().catch(() => ({}));
  if (response.ok) return result;
  if (response.status === 401 && path !== "/api/login") location.assign("/login");
  const { code = "error", message = `The server returned status ${response.status}.` } = result.error ?? {};
  throw new ApiError(response.status, code, message, result);
}

const contactPath = (id) => `/api/contacts/${encodeURIComponent(id)}`;
const queryString = (values) => {
  const parts = Object.entries(values).filter(([, value]) => value !== "" && value !== null && value !== undefined);
  return new URLSearchParams(parts).toString();
};

export const api = {
  login: (user, password) => request("POST", "/api/login", { user, password }),
  logout: () => request("POST", "/api/logout"),
  password: (old, replacement) => request("POST", "/api/password", { old, new: replacement }),
  session: () => request("GET", "/api/session"),
  info: () => request("GET", "/api/info"),
  contacts: (values) => request("GET", `/api/contacts?${queryString(values)}`),
  contact: (id) => request("GET", contactPath(id)),
  measure: (id, body) => request("POST", `${contactPath(id)}/measure`, body),
  decide: (id, body) => request("POST", `${contactPath(id)}/decisions`, body),
  undo: (id, body) => request("POST", `${contactPath(id)}/undo`, body),
  costs: (id) => request("GET", `${contactPath(id)}/costs`),
  request: (id, body) => request("POST", `${contactPath(id)}/requests`, body),
  advise: (id, body) => request("POST", `${contactPath(id)}/advice`, body),
  fleet: () => request("GET", "/api/fleet"),
  map: () => request("GET", "/api/map"),
  exportUrl: (format, filter) => `/api/export/contacts.${format}?${queryString(filter)}`,
  reportUrl: (id) => `/report/${encodeURIComponent(id)}`,
  imageUrl: (id, version, layer) => `${contactPath(id)}/versions/${version}/picture.png?${queryString({ layer, map: "grey" })}`,
  maskUrl: (id, version, kind, layer) => `${contactPath(id)}/versions/${version}/mask.png?${queryString({ kind, layer })}`,
  thumbnailUrl: (id, version) => `${contactPath(id)}/versions/${version}/thumbnail.png`,
};
