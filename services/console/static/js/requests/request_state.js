// State of a request from the order to its result, as text.

import { bytes, duration, percent, requestKind, time } from "../base/format.js";
import { t } from "../texts.js";

const PENDING = ["waiting", "asked", "sent", "delivered", "confirmed"];

/** Whether a request without a result is late. */
const isLate = (request, now_s) => request.arrived_utc_s === null && request.late_utc_s !== null && now_s > request.late_utc_s;

/** Whether a request is on its way or waits for its result. */
export function isPending(request, now_s) {
  return PENDING.includes(request.state) && request.arrived_utc_s === null && !isLate(request, now_s);
}

function resultText(request) {
  const { result } = request;
  const name = request.kind === "revisit" ? result.id.split(".").filter((_, index) => index === 2 || index === 4).join("/")
    : ["wider", "original", "region"].includes(request.kind) ? t(`layer.${request.kind}`) : t("request_state.version", { version: result.version });
  const elapsed = duration(request.arrived_utc_s - request.asked_utc_s);
  return t("request_state.arrived", { name, bytes: bytes(result.bytes), elapsed });
}

function expectedText(request) {
  if (request.expected_utc_s !== null) return t("request_state.expected", { time: time(request.expected_utc_s).slice(0, 5) });
  if (request.earliest_utc_s !== null) return t("request_state.earliest", { time: time(request.earliest_utc_s).slice(0, 5) });
  return request.kind === "revisit" ? t("request_state.after_sailing") : "";
}

/** `{text, tone}` of a request; the tone is "good", "bad" or "". */
export function requestState(request, vehicle, now_s) {
  const tries = t("request_state.tries", { count: request.times_sent });
  if (request.arrived_utc_s !== null) return { text: resultText(request), tone: "good" };
  if (request.state === "refused") {
    const text = request.reason === "unsupported" ? t("request_state.unsupported", { vehicle, tries }) : t("request_state.refused", { reason: request.reason, tries });
    return { text, tone: "bad" };
  }
  if (isLate(request, now_s)) return { text: t(request.result ? "request_state.late_part" : "request_state.late", { time: time(request.late_utc_s).slice(0, 5) }), tone: "bad" };
  if (request.result) {
    const share = request.bytes_wanted > 0 ? percent(Math.min(99, Math.max(1, Math.round((100 * request.result.bytes) / request.bytes_wanted)))) : bytes(request.result.bytes);
    return { text: [t("request_state.arriving", { share }), expectedText(request)].filter(Boolean).join("; "), tone: "" };
  }
  if (request.state === "expired") return { text: t("request_state.expired", { tries }), tone: "bad" };
  return { text: [t(`request_state.${request.state}`), expectedText(request)].filter(Boolean).join("; "), tone: "" };
}

/** Heading of a request in lists. */
export function requestTitle(request) {
  const cost = request.airtime_s === null ? t("request_state.cost_unknown") : t("request_state.cost", { time: duration(request.airtime_s) });
  return { kind: requestKind(request.kind), detail: t("request_state.order", { time: time(request.asked_utc_s), user: request.user, cost }) };
}
