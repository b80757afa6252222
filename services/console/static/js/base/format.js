// Text of values. An unknown value is a dash.

import { hasText, number, t } from "../texts.js";
import { state } from "./state.js";

export { number };

export const DASH = "–";
export const VERDICTS = ["mine_like", "not_mine_like", "unsure"];
const SYMBOLS = { mine_like: "▲", not_mine_like: "○", unsure: "?", disputed: "≠", unreviewed: "◆" };

export const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export const verdict = (name) => (hasText(`verdict.${name}`) ? t(`verdict.${name}`) : name ?? DASH);
/** Name of a class of objects; names of a configuration have no translation. */
export const className = (name) => (hasText(`class.${name}`) ? t(`class.${name}`) : name);
/** Name of a kind of request for operators. */
export const requestKind = (kind) => (hasText(`request.${kind}`) ? t(`request.${kind}`) : kind);

/** Name of a layer for operators: tiles of a codebook are not raw pixels. */
export function layerName(version, name) {
  if (name === "raw" && version?.texture === "codebook") return t("layer.tiles");
  return hasText(`layer.${name}`) ? t(`layer.${name}`) : name;
}

/** Smallest detail of an image, for example "≈ 0.25 m"; null where it is not known. */
export const sharpness = (/** @type {Version} */ version) => (known(version.sharp_to_m) ? `≈ ${quantity(version.sharp_to_m, "m", version.sharp_to_m < 0.995 ? 2 : 1)}` : null);
export const symbol = (name) => SYMBOLS[name] ?? "·";

/** A number and its unit, separated by a thin space. */
export function quantity(value, unit = "", digits = 1) {
  return known(value) ? `${number(value, digits)}${unit ? `\u202f${unit}` : ""}` : DASH;
}

/** @param {number} area_m2 */
export const area = (area_m2) => (area_m2 >= 1e5 ? quantity(area_m2 / 1e6, "km²", 2) : quantity(area_m2, "m²", 0));

export const percent = (value, digits = 0) => (known(value) ? `${number(value, digits)}\u202f%` : DASH);

/** Whether a contact is unauthenticated where others are not; the header states what holds for the whole site. */
export const unauthenticated = (/** @type {Contact | Version} */ row) => row.authenticated === false && state.counts.authenticated !== false;

/** Statement about the authentication of a contact's acoustic frames; null where it is not known. */
export function authentication(/** @type {Contact | Version} */ row) {
  if (row.authenticated === null || row.authenticated === undefined) return null;
  return t(row.authenticated ? "format.authenticated" : "format.unauthenticated");
}

/** Probabilities of a contact as whole percentages that add up to 100; null where they are not known. */
export function probabilities(/** @type {Contact} */ row) {
  if (!known(row.p_mine_like) || !known(row.p_other_object)) return null;
  const mineLike = Math.round(100 * row.p_mine_like);
  const other = Math.min(Math.round(100 * row.p_other_object), 100 - mineLike);
  return t("format.probabilities", { mine_like: percent(mineLike), other: percent(other), seabed: percent(100 - mineLike - other) });
}

/** Probability that a contact is mine-like, or the detector's confidence where it is not known; null without both. */
export function probability(/** @type {Contact} */ row) {
  if (known(row.p_mine_like)) return t("format.mine_like", { percent: percent(100 * row.p_mine_like) });
  return known(row.atd_confidence) ? t("format.detector", { value: quantity(row.atd_confidence, "", 2) }) : null;
}

/** Statement about the despeckling of an image; null where it is not known. */
export function despeckling(/** @type {Version} */ version) {
  if (!known(version.despeckle_strength)) return null;
  return version.despeckle_strength > 0 ? t("format.despeckle_strength", { value: number(version.despeckle_strength, 2) }) : t("format.not_despeckled");
}

/** What has been received of an image: its bytes, or the percentage of an announced length, below 100 until complete. */
export function received(/** @type {Contact | Version} */ row) {
  if (row.stage === "record") return t("received.record");
  if (row.stage === "part") return percent(Math.min(99, Math.max(1, Math.round(row.percent_received))));
  return t(`received.${row.stage}`, { bytes: bytes(row.bytes_received) });
}

export function withSigma(value, sigma, unit = "m", digits = 2) {
  if (!known(value)) return DASH;
  const error = known(sigma) ? ` ± ${number(sigma, digits)}` : "";
  return `${number(value, digits)}${error}\u202f${unit}`;
}

/** Time in UTC. */
export function time(utc_s, { date = false } = {}) {
  if (!known(utc_s)) return DASH;
  const text = new Date(utc_s * 1000).toISOString();
  return date ? `${text.slice(0, 10)} ${text.slice(11, 19)} UTC` : `${text.slice(11, 19)}`;
}

/** Seconds since 1970 of a date and time in UTC; null for an empty field. */
export const secondsOf = (/** @type {HTMLInputElement} */ field) => (field.value ? Date.parse(`${field.value}Z`) / 1000 : null);

/** A duration in its two largest units. */
export function duration(seconds) {
  if (!known(seconds)) return DASH;
  const s = Math.max(0, seconds);
  if (s < 9.95) return `${number(s, 1)}\u202fs`;
  if (s < 90) return `${Math.round(s)}\u202fs`;
  if (s < 5400) return `${Math.floor(s / 60)}\u202fmin ${String(Math.round(s % 60) % 60).padStart(2, "0")}\u202fs`;
  if (s < 172800) return `${Math.floor(s / 3600)}\u202fh ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")}\u202fmin`;
  return `${Math.floor(s / 86400)}\u202fd`;
}

export const bytes = (value) => (known(value) ? `${number(value)}\u202fB` : DASH);

function degrees(value, positive, negative, width) {
  const minutes = Math.round(Math.abs(value) * 60000) / 1000; // before the division, so that no text has 60.000′
  const whole = Math.floor(minutes / 60);
  return `${String(whole).padStart(width, "0")}° ${number(minutes - whole * 60, 3, { minimumIntegerDigits: 2 })}′ ${value < 0 ? negative : positive}`;
}

export const latitude = (lat_deg) => degrees(lat_deg, "N", "S", 2);
export const longitude = (lon_deg) => degrees(lon_deg, "E", "W", 3);

/** Degrees and decimal minutes, as on charts. */
export function position(lat_deg, lon_deg) {
  if (!known(lat_deg) || !known(lon_deg)) return t("format.no_position");
  return `${latitude(lat_deg)}  ${longitude(lon_deg)}`;
}

const SHORE_TONES = { waiting: "", relay: "", delivered: "good", refused: "bad", withdrawn: "", none: "" };
const VEHICLE_TONES = { waiting: "", asked: "", sent: "", confirmed: "good", withdrawn: "", disputed: "", refused: "bad", expired: "bad", none: "" };

/** Delivery state to the shore site: [text, CSS class]. */
export function shoreState(/** @type {Delivery} */ delivery) {
  const step = delivery?.shore;
  return step in SHORE_TONES ? [t(`delivery.shore.${step}`), SHORE_TONES[step]] : [DASH, ""];
}

/** Delivery state to the vehicle: [text, CSS class]. */
export function vehicleState(/** @type {Delivery} */ delivery) {
  const step = delivery?.vehicle;
  if (!(step in VEHICLE_TONES)) return [DASH, ""];
  const times = delivery.times_sent && ["sent", "confirmed", "expired"].includes(step) ? `, ${t("delivery.times", { count: delivery.times_sent })}` : "";
  return [t(`delivery.vehicle.${step}`) + times, VEHICLE_TONES[step]];
}

/** Distance between the lines of a grid or axis: 1, 2 or 5 times a power of ten. */
export function niceStep(span, lines) {
  const rough = span / Math.max(1, lines);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10;
  return step * power;
}
