// Layers of a contact that are images of their own: more seabed around it, and the image without despeckling.

import { t } from "../texts.js";

const EXPANDED_PIXEL = 2; // ratio of the pixel sizes of the wider image and of the contact's image
const OUTLINE_COLOUR = "#52e0ff";

/** Related image of a layer: `{id, relation, versions}`; null for a layer of the contact's own image. */
export const relatedOf = (detail, layer) => detail?.related.find((one) => one.relation === layer) ?? null;

/** Layers of the related images that have a picture; they are not measured. */
export function relatedLayers(detail) {
  return (detail?.related ?? []).filter((one) => one.versions.some((version) => version.codec)).map((one) => ({
    name: one.relation, measurable: false, synthesised: false, reason: t(`related_images.${one.relation}_title`),
  }));
}

/** Newest version with a picture of the image of a layer, with the identifier of this image; null for own layers. */
export function relatedVersion(detail, layer) {
  const related = relatedOf(detail, layer);
  const version = related?.versions.findLast((one) => one.codec);
  return version ? { ...version, contact_id: related.id, place: related.place } : null;
}

/** Outline of the contact's image on the wider image, as lines of the image view; empty if its place is not known. */
export function outlineOf(version, wider) {
  if (!version || !wider.place) return [];
  const [top, left] = wider.place;
  const [bottom, right] = [top + version.height_px / EXPANDED_PIXEL, left + version.width_px / EXPANDED_PIXEL];
  const corners = [[top, left], [top, right], [bottom, right], [bottom, left]];
  return corners.map((from, index) => ({ from, to: corners[(index + 1) % 4], text: "", colour: OUTLINE_COLOUR, outline: true }));
}

/** Whether zooming out from the whole image continues into the wider image. */
export function continuesOut(view, factor) {
  return factor < 1 && !view.zoomed && !view.measurement.active && relatedVersion(view.detail, view.layer) === null
    && relatedVersion(view.detail, "wider") !== null;
}
