// Link and fleet: what is known, since when, and what is too old to be believed.

import { fill, h } from "./dom.js";
import { DASH, bytes, duration, percent, position, quantity, time } from "./format.js";
import { listen, now, state } from "./state.js";

/** A value that says its age, and is struck as stale when it is older than `limit_s`. */
function aged(words, utc_s, limit_s) {
  if (utc_s === null || utc_s === undefined) return h("span", { class: "stale", text: "never" });
  const age_s = now() - utc_s;
  const old = age_s > limit_s || !state.online;
  return h("span", { class: old ? "stale number" : "number" }, words ? `${words} ` : "", `${duration(age_s)} ago${old ? " — stale" : ""}`);
}

function fact(name, ...value) {
  return [h("dt", { text: name }), h("dd", { class: "number" }, value)];
}

const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
const until = (utc_s) => (utc_s <= now() ? "due" : `in ${duration(utc_s - now())}`);

function queueTable(queue) {
  if (!queue) return h("p", { class: "muted", text: "The vehicle's queue is not seen on this side of the water." });
  const rows = queue.images.slice(0, 8).map((one) => h("tr", {},
    h("td", {}, h("code", { text: one.image_id })), h("td", { class: "number", text: bytes(one.bytes_left) }),
    h("td", { class: "number", text: one.preview_utc_s === null ? "gone" : until(one.preview_utc_s) }),
    h("td", { class: "number", text: until(one.expected_utc_s) })));
  return [
    h("p", {}, `${many(queue.images_waiting, "picture")} and ${many(queue.messages_waiting, "message")} (${bytes(queue.message_bytes)}) waiting; one packet every ${duration(queue.packet_interval_s)}. `, aged("", queue.time_utc_s, state.info.stale_after_s.vehicle)),
    rows.length ? h("table", {}, h("thead", {}, h("tr", {}, ["picture", "left", "preview", "all of it"].map((name, i) => h("th", { scope: "col", class: i ? "number" : "", text: name })))), h("tbody", {}, rows)) : null,
  ];
}

function vehicleCard(one) {
  const limit_s = state.info.stale_after_s.vehicle;
  const stale = one.last_heard_utc_s === null || now() - one.last_heard_utc_s > limit_s || !state.online;
  const loss = one.loss === null ? DASH : percent(100 * one.loss);
  return h("article", { class: stale ? "card old" : "card", "aria-label": one.vehicle_id },
    h("h3", {}, one.vehicle_id, stale ? h("span", { class: "pill stale", text: "stale" }) : h("span", { class: "pill good", text: "heard" })),
    h("dl", { class: "facts" },
      fact("last heard", aged("", one.last_heard_utc_s, limit_s)),
      fact("SNR in / out", `${quantity(one.snr_in_db, "dB")} / ${quantity(one.snr_out_db, "dB")}`),
      fact("rate", one.rate === null ? DASH : `${one.rate}, ${quantity(one.frames_per_minute, "frames a minute")}`),
      fact("frames", `${one.frames}, ${one.bad_frames} bad`),
      fact("loss, last 20 packets", h("span", { class: (one.loss ?? 0) > 0.3 ? "bad" : "", text: loss })),
      fact("range", quantity(one.range_m, "m", 0), " ", one.range_m === null ? null : aged("", one.range_utc_s, limit_s)),
      fact("position", one.lat_deg === null ? DASH : position(one.lat_deg, one.lon_deg), " ", one.lat_deg === null ? null : aged("at its last contact,", one.position_utc_s, limit_s)),
      fact("open orders", String(one.open_orders))),
    h("h4", { text: "Acoustic queue" }), queueTable(one.queue));
}

function serviceRow(one) {
  const old = one.stale || !state.online;
  const tone = old || one.state === "silent" ? "stale" : one.state === "ok" ? "good" : one.state === "degraded" ? "bad" : "";
  return h("tr", {}, h("td", { text: one.platform_id }), h("td", { text: one.service }),
    h("td", {}, h("span", { class: tone, text: old && one.state !== "silent" ? `was ${one.state}` : one.state })),
    h("td", {}, aged("", one.time_utc_s, state.info.stale_after_s.service)), h("td", { class: "detail", text: one.detail }));
}

export class FleetView {
  constructor() {
    this.vehicles = h("div", { class: "cards" });
    this.services = h("tbody", {});
    this.heard = h("ol", { class: "heard number", "aria-label": "Frames heard" });
    this.frames = [];
    this.element = h("section", { class: "fleet hidden", "aria-label": "Link and fleet" },
      h("div", {}, h("h2", { text: "Vehicles" }), this.vehicles),
      h("div", {}, h("h2", { text: "Services" }),
        h("table", {}, h("thead", {}, h("tr", {}, ["platform", "service", "state", "last said", "detail"].map((name) => h("th", { scope: "col", text: name })))), this.services),
        h("h2", { text: "Heard last" }), this.heard));
    listen("fleet", () => this.draw());
    listen("frame", (frame) => { this.frames = [frame, ...this.frames].slice(0, 12); });
    setInterval(() => this.draw(), 1000);
  }

  draw() {
    if (this.element.classList.contains("hidden") || !state.fleet) return;
    const { vehicles, services } = state.fleet;
    fill(this.vehicles, vehicles.length ? vehicles.map(vehicleCard) : h("p", { class: "muted", text: "No vehicle has been heard." }));
    fill(this.services, services.map(serviceRow));
    fill(this.heard, this.frames.map((one) => h("li", { text: `${time(one.utc_s)}  ${one.vehicle_id ?? "?"}  ${bytes(one.bytes)}  rate ${one.rate ?? DASH}  ${quantity(one.snr_in_db, "dB")}` })));
  }
}
