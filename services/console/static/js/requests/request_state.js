// State of a request from the order to its result, as text.

import { bytes, duration, percent, requestKind, time } from "../base/format.js";
import { t } from "../texts.js";

const PENDING = ["waiting", "asked", "sent", "delivered", "confirmed"];

/** Whether a request without a result is late. */
const isLate = (request, now_s) => request.arrived_utc_s === null && request.late_utc_s !== null && now_s > request.late_utc_s;

/** Whether an order that has no answer was accepted: to send the image next. */
const isOrdered = (request) => request.kind === "prioritise" && ["confirmed", "delivered"].includes(request.state);

/** Whether a request is on its way or waits for its result. */
export function isPending(/** @type {VehicleRequest} */ request, now_s) {
  return PENDING.includes(request.state) && !isOrdered(request) && request.arrived_utc_s === null && !isLate(request, now_s);
}

function resultText(/** @type {VehicleRequest} */ request) {
  const { result } = request;
  const name = request.kind === "revisit" ? result.id.split(".").filter((_, index) => index === 2 || index === 4).join("/")
    : ["expand", "original", "region"].includes(request.kind) ? t(`layer.${request.kind}`) : t("request_state.version", { version: result.version });
  const elapsed = duration(request.arrived_utc_s - request.asked_utc_s);
  return t("request_state.arrived", { name, bytes: bytes(result.bytes), elapsed });
}

/** Time until the answer, in seconds; empty where it is not known. */
function countdown(/** @type {VehicleRequest} */ request, now_s) {
  const { expected_utc_s: expected, probable_utc_s: probable } = request;
  if (expected === null || probable === null) return request.kind === "revisit" ? t("request_state.after_sailing") : "";
  if (now_s < expected) return t("request_state.expected", { time: duration(expected - now_s), most: duration(probable - now_s) });
  return now_s < probable ? t("request_state.probable", { time: duration(probable - now_s) }) : t("request_state.overdue", { time: duration(now_s - probable) });
}

/** `{text, tone, countdown}` of a request; the tone is "good", "bad" or "". */
export function requestState(/** @type {VehicleRequest} */ request, vehicle, now_s) {
  const tries = t("request_state.tries", { count: request.times_sent });
  if (isOrdered(request)) return { text: t(request.state === "confirmed" ? "request_state.prioritised" : "request_state.delivered"), tone: "good" };
  if (request.arrived_utc_s !== null) return { text: resultText(request), tone: "good" };
  if (request.state === "refused") {
    const text = request.reason === "unsupported" ? t("request_state.unsupported", { vehicle, tries }) : t("request_state.refused", { reason: request.reason, tries });
    return { text, tone: "bad" };
  }
  if (isLate(request, now_s)) return { text: t(request.result ? "request_state.late_part" : "request_state.late", { time: time(request.late_utc_s).slice(0, 5) }), tone: "bad" };
  if (request.result) {
    const share = request.bytes_wanted > 0 ? percent(Math.min(99, Math.max(1, Math.round((100 * request.result.bytes) / request.bytes_wanted)))) : bytes(request.result.bytes);
    return { text: t("request_state.arriving", { share }), tone: "", countdown: countdown(request, now_s) };
  }
  if (request.state === "expired") return { text: t("request_state.expired", { tries }), tone: "bad" };
  return { text: t(`request_state.${request.state}`), tone: "", countdown: countdown(request, now_s) };
}

/** Heading of a request in lists. */
export function requestTitle(/** @type {VehicleRequest} */ request) {
  const cost = request.airtime_s === null ? t("request_buttons.cost_unknown") : t("request_state.cost", { time: duration(request.airtime_s) });
  return { kind: requestKind(request.kind), detail: t("request_state.order", { time: time(request.asked_utc_s), user: request.user, cost }) };
}
