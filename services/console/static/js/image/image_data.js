// Images and masks of the server, gain and colour maps.

/** @typedef {{width: number, height: number, levels: Uint8Array, missing: Uint8Array, source?: {id: string, version: number, layer: string, sha256: string}}} SonarImage */

import { api } from "../base/api.js";
import { t } from "../texts.js";

/**
 * Load an image; its digest is null for a mask.
 *
 * @param {string} url
 * @param {RequestCache} cache
 */
async function loadGrey(url, cache = "default") {
  const { file, sha256 } = await api.image(url, cache);
  const bitmap = await createImageBitmap(file, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
  const levels = new Uint8Array(bitmap.width * bitmap.height);
  for (let i = 0; i < levels.length; i += 1) levels[i] = data[4 * i];
  return { width: bitmap.width, height: bitmap.height, levels, sha256 };
}

/** Load an image with a digest. The browser's cache can hold one from before the server removed its pixels. */
async function loadWithDigest(url, sha256) {
  let image = await loadGrey(url);
  if (image.sha256 !== sha256) image = await loadGrey(url, "reload");
  if (image.sha256 !== sha256) throw new Error(t("image_data.other_digest"));
  return image;
}

/**
 * Load an image version. An empty mask has no URL (null).
 *
 * `source`: `{id, version, layer, sha256}` of the image; the server's response must have this digest.
 * Returns grey levels 0…255 and a mask, rows along-track, columns across-track.
 * @returns {Promise<SonarImage>}
 */
export async function loadImage(source, imageUrl, missingUrl) {
  const [image, missing] = await Promise.all([loadWithDigest(imageUrl, source.sha256), missingUrl && loadGrey(missingUrl)]);
  return { ...image, source: Object.freeze(source), missing: missing?.levels ?? new Uint8Array(image.levels.length) };
}

const toByte = (value) => Math.max(0, Math.min(255, Math.round(value)));

// Colour maps: (0…1) → red, green, blue in 0…255. Lightness increases monotonically.
export const MAPS = {
  grey: (v) => [255 * v, 255 * v, 255 * v],
  copper: (v) => [255 * Math.min(1, 1.25 * v), 255 * 0.78 * v, 255 * 0.5 * v],
};

/** Table of 256 colours of a map, with black point `low` and white point `high` in percent. */
export function colourTable(map, low, high) {
  const colours = new Uint8ClampedArray(256 * 3);
  const black = low * 2.55;
  const span = Math.max(1, (high - low) * 2.55);
  for (let level = 0; level < 256; level += 1) {
    const value = Math.max(0, Math.min(1, (level - black) / span));
    colours.set((MAPS[map] ?? MAPS.grey)(value).map(toByte), 3 * level);
  }
  return colours;
}

/** Apply a colour table to an image. Missing pixels are black with every map. */
export function colourise(image, colours) {
  const canvas = new OffscreenCanvas(image.width, image.height);
  const pixels = new ImageData(image.width, image.height);
  for (let i = 0; i < image.levels.length; i += 1) {
    const colour = 3 * image.levels[i];
    const received = image.missing[i] === 0;
    for (let c = 0; c < 3; c += 1) pixels.data[4 * i + c] = received ? colours[colour + c] : 0;
    pixels.data[4 * i + 3] = 255;
  }
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  return canvas;
}

/** A mask as a canvas with opaque pixels; null for an empty mask. */
export function maskCanvas(mask, width, height) {
  if (!mask.some((value) => value > 0)) return null;
  const canvas = new OffscreenCanvas(width, height);
  const image = new ImageData(width, height);
  for (let i = 0; i < mask.length; i += 1) image.data[4 * i + 3] = mask[i] > 0 ? 255 : 0;
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

/** Range of grey levels, in percent, with 98 % of the received pixels: the automatic gain. */
export function autoRange(image) {
  const histogram = new Uint32Array(256);
  let count = 0;
  for (let i = 0; i < image.levels.length; i += 1) {
    if (image.missing[i] === 0) {
      histogram[image.levels[i]] += 1;
      count += 1;
    }
  }
  const at = (share) => {
    let sum = 0;
    for (let level = 0; level < 256; level += 1) {
      sum += histogram[level];
      if (sum >= share * count) return level;
    }
    return 255;
  };
  if (count === 0) return [0, 100];
  const [low, high] = [at(0.01), at(0.99)];
  return high > low ? [low / 2.55, high / 2.55] : [0, 100];
}
