// What is on the map: grid, scale, north, rings, tracks, contacts. All in local metres: x east, y north.

import { niceStep, symbol } from "./format.js";

const TONES = { mine_like: "mine", not_mine_like: "not", unsure: "unsure", unreviewed: "accent" };
const METRES = (value) => (value >= 1000 ? `${value / 1000} km` : `${value} m`);

/** Words that stay legible on whatever lies below. */
function halo(context, words, x, y, ink, paper) {
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.strokeStyle = paper;
  context.strokeText(words, x, y);
  context.fillStyle = ink;
  context.fillText(words, x, y);
}

export function drawFrame(stage, { ring_m: rings, vessel }) {
  const { context, width, height, toScreen, perMetre, colour, centre } = stage;
  const step = niceStep(width / perMetre, width / 110);
  const line = () => {
    context.strokeStyle = colour("grid");
    context.lineWidth = 1;
    context.stroke();
  };
  context.textAlign = "left";
  context.textBaseline = "top";
  const west = centre.x - width / 2 / perMetre;
  const south = centre.y - height / 2 / perMetre;
  const label = (value) => (step < 1 ? value.toFixed(1) : String(Math.round(value)));
  for (let x = Math.ceil(west / step) * step; x < west + width / perMetre; x += step) {
    const [at] = toScreen(x, 0);
    context.beginPath();
    context.moveTo(at, 0);
    context.lineTo(at, height);
    line();
    halo(context, label(x), at + 3, height - 18, colour("muted"), colour("water"));
  }
  for (let y = Math.ceil(south / step) * step; y < south + height / perMetre; y += step) {
    const [, at] = toScreen(0, y);
    context.beginPath();
    context.moveTo(0, at);
    context.lineTo(width, at);
    line();
    halo(context, label(y), 4, at + 2, colour("muted"), colour("water"));
  }
  const [x, y] = toScreen(vessel?.x_m ?? 0, vessel?.y_m ?? 0);
  for (const radius of rings) {
    context.strokeStyle = colour("muted");
    context.lineWidth = 1.3;
    context.setLineDash([7, 6]);
    context.beginPath();
    context.arc(x, y, radius * perMetre, 0, 2 * Math.PI);
    context.stroke();
    context.setLineDash([]);
    context.textAlign = "center";
    halo(context, METRES(radius), x, y - radius * perMetre + 3, colour("muted"), colour("water"));
  }
  context.textAlign = "left";
  if (vessel) {
    context.fillStyle = colour("text");
    context.fillRect(x - 6, y - 6, 12, 12);
    halo(context, "vessel", x + 10, y - 8, colour("text"), colour("water"));
  }
  drawScale(stage);
  drawNorth(stage);
}

function drawScale({ context, width, height, perMetre, colour }) {
  const metres = niceStep(width / perMetre, 7);
  const [x, y, length] = [width - metres * perMetre - 24, height - 46, metres * perMetre];
  context.fillStyle = colour("bg");
  context.globalAlpha = 0.85;
  context.fillRect(x - 12, y - 24, length + 24, 40);
  context.globalAlpha = 1;
  context.strokeStyle = colour("text");
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x, y - 5);
  context.lineTo(x, y + 5);
  context.moveTo(x, y);
  context.lineTo(x + length, y);
  context.moveTo(x + length, y - 5);
  context.lineTo(x + length, y + 5);
  context.stroke();
  context.fillStyle = colour("text");
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.fillText(METRES(metres), x + length / 2, y - 3);
}

function drawNorth({ context, width, colour }) {
  const x = width - 34;
  context.fillStyle = colour("text");
  context.beginPath();
  context.moveTo(x, 14);
  context.lineTo(x + 9, 42);
  context.lineTo(x, 35);
  context.lineTo(x - 9, 42);
  context.fill();
  context.textAlign = "center";
  context.textBaseline = "top";
  halo(context, "N", x, 45, colour("text"), colour("water"));
}

export function drawTracks({ context, toScreen, colour }, { vehicles }) {
  for (const { vehicle_id: name, track, stale } of vehicles) {
    if (!track.length) continue;
    const points = track.map(([x, y]) => toScreen(x, y));
    context.strokeStyle = colour(stale ? "stale" : "accent");
    context.lineWidth = 2;
    context.setLineDash(stale ? [4, 5] : []);
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
    context.setLineDash([]);
    const [x, y] = points.at(-1);
    context.fillStyle = colour(stale ? "stale" : "accent");
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.fill();
    context.textAlign = "left";
    context.textBaseline = "middle";
    halo(context, stale ? `${name} (stale)` : name, x + 10, y + 14, colour(stale ? "stale" : "text"), colour("water"));
  }
}

export function drawContacts({ context, width, height, toScreen, perMetre, colour }, contacts, chosen) {
  const named = contacts.length <= 60 || perMetre > 2;
  context.textBaseline = "middle";
  for (const one of contacts) {
    const [x, y] = toScreen(one.x_m, one.y_m);
    if (x < -20 || y < -20 || x > width + 20 || y > height + 20) continue;
    const tone = colour(TONES[one.review] ?? "accent");
    if (one.sigma_m && one.sigma_m * perMetre > 8) {
      context.strokeStyle = tone;
      context.lineWidth = 1;
      context.beginPath();
      context.arc(x, y, one.sigma_m * perMetre, 0, 2 * Math.PI);
      context.stroke();
    }
    context.textAlign = "center";
    halo(context, symbol(one.review), x, y, tone, colour("bg"));
    if (one.id === chosen) {
      context.strokeStyle = colour("focus");
      context.lineWidth = 3;
      context.strokeRect(x - 13, y - 13, 26, 26);
    }
    context.textAlign = "left";
    if (named || one.id === chosen) halo(context, one.name.split("/").at(-1), x + 14, y, colour("text"), colour("water"));
  }
}

/** The contact within 16 px of a point of the screen, null where there is none. */
export function nearest(contacts, toScreen, x, y) {
  let best = null;
  let least = 16;
  for (const one of contacts) {
    const [cx, cy] = toScreen(one.x_m, one.y_m);
    const distance = Math.hypot(cx - x, cy - y);
    if (distance < least) [best, least] = [one, distance];
  }
  return best;
}
