// Geometry of the map: ranges and bearings on the WGS 84 ellipsoid, clusters, steps of the frame.

const RADIANS = Math.PI / 180;
const SEMI_MAJOR_M = 6378137; // WGS 84
const ECCENTRICITY_2 = 0.00669437999014;
const FRAME_STEPS_MIN = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800];
const SEVERITY = { mine_like: 4, disputed: 3, unsure: 2, unreviewed: 1, not_mine_like: 0 };

/** Metres per degree of latitude (`north`) and longitude (`east`) at a latitude. */
export function metresPerDegree(lat_deg) {
  const w2 = 1 - ECCENTRICITY_2 * Math.sin(lat_deg * RADIANS) ** 2;
  return {
    north: (RADIANS * SEMI_MAJOR_M * (1 - ECCENTRICITY_2)) / w2 ** 1.5,
    east: (RADIANS * SEMI_MAJOR_M * Math.cos(lat_deg * RADIANS)) / Math.sqrt(w2),
  };
}

/** Longitude within 180° of a reference: the same meridian, without a step at the 180° meridian. */
export const nearLongitude = (lon_deg, reference_deg) => lon_deg - 360 * Math.round((lon_deg - reference_deg) / 360);

/** Range and true bearing at `from`, by Gauss's mid-latitude formulae; within 0.1 % and 0.1° to 100 km below 75° latitude. */
export function rangeBearing(from, to) {
  const middle_deg = (from.lat_deg + to.lat_deg) / 2;
  const { north, east } = metresPerDegree(middle_deg);
  const lon_deg = nearLongitude(to.lon_deg, from.lon_deg) - from.lon_deg;
  const [x_m, y_m] = [lon_deg * east, (to.lat_deg - from.lat_deg) * north];
  const bearing_deg = Math.atan2(x_m, y_m) / RADIANS - (lon_deg * Math.sin(middle_deg * RADIANS)) / 2;
  return { range_m: Math.hypot(x_m, y_m), bearing_deg: (bearing_deg + 360) % 360 };
}

/** `[lat_deg, lon_deg]` at a bearing and range of a position, for ranges of sonar and rings. */
export function offset(from, bearing_deg, range_m) {
  const [x_m, y_m] = [range_m * Math.sin(bearing_deg * RADIANS), range_m * Math.cos(bearing_deg * RADIANS)];
  const lat_deg = from.lat_deg + y_m / metresPerDegree(from.lat_deg).north;
  return [lat_deg, from.lon_deg + x_m / metresPerDegree((from.lat_deg + lat_deg) / 2).east];
}

/**
 * Rectangle that a vehicle surveys on a leg, to both sides of its track. All have the same sense of rotation, so that
 * overlapping ones are one area.
 * @param {{lat_deg: number, lon_deg: number}} from
 * @param {{lat_deg: number, lon_deg: number}} to
 * @param {number} range_m of the sonar, to each side
 */
export function swath(from, to, range_m) {
  const { bearing_deg } = rangeBearing(from, to);
  const [port, starboard] = [bearing_deg - 90, bearing_deg + 90];
  return [offset(from, starboard, range_m), offset(from, port, range_m), offset(to, port, range_m), offset(to, starboard, range_m)];
}

/** Points of a circle in metres. */
export function circle(centre, radius_m, points = 72) {
  return Array.from({ length: points }, (_, index) => offset(centre, (360 * index) / points, radius_m));
}

/**
 * Join points that are close on the screen.
 *
 * `points`: `[{contact, x, y}]` in pixels. Returns `[{contacts, review}]` with the worst verdict of each cluster. A
 * cluster grows around its first point, so that none is wider than `2 * radius_px`.
 */
export function clusters(points, radius_px) {
  const cells = new Map();
  const found = [];
  const seedNear = ({ x, y }, column, row) => {
    for (let dx = -1; dx <= 1; dx += 1) {
      for (let dy = -1; dy <= 1; dy += 1) {
        const near = cells.get(`${column + dx},${row + dy}`)?.find((seed) => Math.hypot(seed.x - x, seed.y - y) < radius_px);
        if (near) return near;
      }
    }
    return null;
  };
  for (const point of points) {
    const [column, row] = [Math.floor(point.x / radius_px), Math.floor(point.y / radius_px)];
    const near = seedNear(point, column, row);
    if (near) {
      near.contacts.push(point.contact);
      continue;
    }
    const seed = { x: point.x, y: point.y, contacts: [point.contact] };
    const key = `${column},${row}`;
    if (cells.has(key)) cells.get(key).push(seed);
    else cells.set(key, [seed]);
    found.push(seed);
  }
  return found.map(({ contacts }) => ({
    contacts,
    review: contacts.reduce((worst, one) => ((SEVERITY[one.review] ?? 0) > (SEVERITY[worst] ?? 0) ? one.review : worst), contacts[0].review),
  }));
}

/** Values in degrees of the frame's lines between two limits, about `lines` of them. */
export function frameLines(low_deg, high_deg, lines) {
  const wanted_min = ((high_deg - low_deg) * 60) / Math.max(1, lines);
  const step_min = FRAME_STEPS_MIN.find((step) => step >= wanted_min) ?? 3600;
  const first = Math.ceil((low_deg * 60) / step_min);
  const last = Math.floor((high_deg * 60) / step_min);
  return Array.from({ length: Math.max(0, last - first + 1) }, (_, index) => ((first + index) * step_min) / 60);
}
