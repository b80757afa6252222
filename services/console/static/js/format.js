// How values are written. What is not known is a dash, never a zero.

export const DASH = "–";
export const VERDICTS = { mine_like: "mine-like", not_mine_like: "not mine-like", unsure: "unsure", unreviewed: "unreviewed" };
const SYMBOLS = { mine_like: "▲", not_mine_like: "○", unsure: "?", unreviewed: "◆" };

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export const verdict = (name) => VERDICTS[name] ?? name ?? DASH;
export const symbol = (name) => SYMBOLS[name] ?? "·";

/** A number with its unit, a thin space between. */
export function quantity(value, unit = "", digits = 1) {
  return known(value) ? `${value.toFixed(digits)}${unit ? `\u202f${unit}` : ""}` : DASH;
}

export const percent = (value, digits = 0) => (known(value) ? `${value.toFixed(digits)}\u202f%` : DASH);

/** Percent received: never 100 before it is, never 0 when something is there. */
export function received(row) {
  if (!known(row.percent_received)) return DASH;
  if (!row.complete) return percent(Math.min(99, Math.max(1, Math.round(row.percent_received))));
  return percent(row.percent_received);
}

export function withSigma(value, sigma, unit = "m", digits = 2) {
  if (!known(value)) return DASH;
  const error = known(sigma) ? ` ± ${sigma.toFixed(digits)}` : "";
  return `${value.toFixed(digits)}${error}\u202f${unit}`;
}

/** UTC, always: ship, vehicle and shore share one clock. */
export function time(utc_s, { date = false } = {}) {
  if (!known(utc_s)) return DASH;
  const text = new Date(utc_s * 1000).toISOString();
  return date ? `${text.slice(0, 10)} ${text.slice(11, 19)} UTC` : `${text.slice(11, 19)}`;
}

/** A length of time in the two units that matter. */
export function duration(seconds) {
  if (!known(seconds)) return DASH;
  const s = Math.max(0, seconds);
  if (s < 9.95) return `${s.toFixed(1)}\u202fs`;
  if (s < 90) return `${Math.round(s)}\u202fs`;
  if (s < 5400) return `${Math.floor(s / 60)}\u202fmin ${String(Math.round(s % 60) % 60).padStart(2, "0")}\u202fs`;
  if (s < 172800) return `${Math.floor(s / 3600)}\u202fh ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")}\u202fmin`;
  return `${Math.floor(s / 86400)}\u202fd`;
}

export const bytes = (value) => (known(value) ? `${Math.round(value).toLocaleString("en")}\u202fB` : DASH);

function degrees(value, positive, negative, width) {
  const minutes = Math.abs(value) * 60;
  const whole = Math.floor(minutes / 60);
  return `${String(whole).padStart(width, "0")}° ${(minutes - whole * 60).toFixed(3).padStart(6, "0")}′ ${value < 0 ? negative : positive}`;
}

/** Degrees and decimal minutes, as a chart has them. */
export function position(lat_deg, lon_deg) {
  if (!known(lat_deg) || !known(lon_deg)) return "position not known";
  return `${degrees(lat_deg, "N", "S", 2)}  ${degrees(lon_deg, "E", "W", 3)}`;
}

/** What a delivery has come to, in words, with `tone` good, bad or empty. */
export function shoreStep(delivery) {
  const words = {
    waiting: ["waiting on this vessel", ""], relay: ["with the relay", ""], delivered: ["ashore", "good"],
    refused: ["refused by the shore", "bad"], none: ["no shore is configured", ""],
  };
  return words[delivery?.shore] ?? [DASH, ""];
}

export function vehicleStep(delivery) {
  const times = delivery?.times_sent ? `, sent ${delivery.times_sent}×` : "";
  const words = {
    waiting: ["waiting on this vessel", ""], asked: ["waiting for the water", ""], sent: [`in the water${times}`, ""],
    confirmed: [`on the vehicle${times}`, "good"], refused: ["refused by the vehicle", "bad"],
    expired: [`not confirmed in time${times}`, "bad"], none: ["no vehicle is reached", ""],
  };
  return words[delivery?.vehicle] ?? [DASH, ""];
}

/** The step that a grid's or an axis's lines should have: 1, 2 or 5 times a power of ten. */
export function niceStep(span, lines) {
  const rough = span / Math.max(1, lines);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10;
  return step * power;
}
