// Layers of a contact that answer requests: surroundings of its image, regions of it, and the image without despeckling.

import { t } from "../texts.js";

const EXPANDED_PIXEL = 2; // ratio of the pixel sizes of the expanded image and of the contact's image
const OUTLINE_COLOUR = "#52e0ff";

const withImage = (one) => one.versions.some((version) => version.codec);

/** Related images of a layer that have an image, the earliest first: `{id, relation, versions}`. */
const relatedOf = (detail, layer) => (detail?.related ?? []).filter((one) => one.relation === layer && withImage(one));

/** Layers of the related images that have an image, with the reason why they are not measured. */
export function relatedLayers(/** @type {ContactDetail} */ detail) {
  const names = new Set((detail?.related ?? []).filter(withImage).map((one) => one.relation));
  return [...names].map((name) => ({ name, reason: t(`related_images.${name}_title`) }));
}

const newestOf = (related) => ({ ...related.versions.findLast((one) => one.codec), contact_id: related.id });

/** Newest version of the newest image of a layer, with the identifier of this image; null for own layers. */
export function relatedVersion(/** @type {ContactDetail} */ detail, layer) {
  const related = relatedOf(detail, layer).at(-1);
  return related ? newestOf(related) : null;
}

/**
 * How a layer is composed of several images: regions on the contact's image, or this image on the expanded one.
 *
 * Returns `{layer, base, factor, parts, mark, box}`: `base` is drawn in pixels of 1 / `factor` of its size, and `parts`, `{version, box}`,
 * at their places in these pixels: [first row, first column, last row + 1, last column + 1]. `mark` and `box` are those of the contact.
 * Null for a layer of one image, and where no place is known.
 */
export function compositionOf(detail, shown, layer) {
  const placed = relatedOf(detail, layer).filter((one) => one.box);
  if (!placed.length || !shown?.codec || shown.height_px !== detail.contact.height_px || shown.width_px !== detail.contact.width_px) return null;
  if (layer === "region") return { layer, base: shown, factor: 1, parts: placed.map((one) => ({ version: newestOf(one), box: one.box })), mark: shown.mark, box: shown.box };
  const expanded = placed.at(-1);
  const part = expanded.box.map((value) => value * EXPANDED_PIXEL);
  const [row, column] = part;
  const { mark, box } = shown;
  return {
    layer, base: newestOf(expanded), factor: EXPANDED_PIXEL, parts: [{ version: shown, box: part }],
    mark: mark && { ...mark, row: mark.row + row, column: mark.column + column, columns: mark.columns.map((one) => one + column) },
    box: box && { rows: box.rows.map((one) => one + row), columns: box.columns.map((one) => one + column) },
  };
}

/** Compose images: pixels of `parts`, `{image, box}`, replace those of `base`, except where they were not received. */
export function compose(base, factor, parts) {
  const [width, height] = [base.width * factor, base.height * factor];
  const out = { width, height, levels: new Uint8Array(width * height), missing: new Uint8Array(width * height) };
  const copy = (image, from, to) => {
    out.levels[to] = image.levels[from];
    out.missing[to] = image.missing[from];
  };
  for (let y = 0; y < height; y += 1) {
    for (let x = 0; x < width; x += 1) copy(base, Math.floor(y / factor) * base.width + Math.floor(x / factor), y * width + x);
  }
  for (const { image, box: [top, left, bottom, right] } of parts) {
    for (let y = Math.max(0, top); y < Math.min(height, bottom); y += 1) {
      const row = Math.floor(((y - top) * image.height) / (bottom - top)) * image.width;
      for (let x = Math.max(0, left); x < Math.min(width, right); x += 1) {
        const from = row + Math.floor(((x - left) * image.width) / (right - left));
        if (!image.missing[from]) copy(image, from, y * width + x);
      }
    }
  }
  return out;
}

/** Outlines of the parts of a composed layer, as lines of the image view. */
export function outlinesOf(composition) {
  return (composition?.parts ?? []).flatMap(({ box: [top, left, bottom, right] }) => {
    const corners = [[top, left], [top, right], [bottom, right], [bottom, left]];
    return corners.map((from, index) => ({ from, to: corners[(index + 1) % 4], text: "", colour: OUTLINE_COLOUR, outline: true }));
  });
}

/** Whether zooming out from the whole image continues into the expanded image. */
export function continuesOut(view, factor) {
  return factor < 1 && !view.zoomed && !view.measurement.active && relatedVersion(view.detail, view.layer) === null
    && relatedVersion(view.detail, "expand") !== null;
}
