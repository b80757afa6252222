// Times of past events as text.

import { duration, time } from "./format.js";
import { now, state } from "./state.js";
import { t } from "../texts.js";

const DAY_S = 86400;

/** Time of day within the last day, otherwise the date, in UTC. */
export function since(utc_s) {
  if (now() - utc_s < DAY_S) return t("age.time", { time: time(utc_s).slice(0, 5) });
  return date(utc_s);
}

/** Date in UTC: 10 Sep 2013. */
export function date(utc_s) {
  const format = new Intl.DateTimeFormat(document.documentElement.lang, { day: "numeric", month: "short", year: "numeric", timeZone: "UTC" });
  const parts = Object.fromEntries(format.formatToParts(new Date(1000 * utc_s)).map(({ type, value }) => [type, value]));
  return `${parts.day} ${parts.month} ${parts.year}`;
}

/**
 * Whether a value is older than a limit, or may be: without events of the server its age is not known.
 * @param {number} utc_s time of the value
 * @param {number} limit_s
 */
export const isStale = (utc_s, limit_s) => !state.online || now() - utc_s > limit_s;

/** Age of a value: "12 s ago", or the date of one that is older than a day. */
export function age(utc_s) {
  const age_s = now() - utc_s;
  return age_s < DAY_S ? t("age.ago", { duration: duration(age_s) }) : date(utc_s);
}
