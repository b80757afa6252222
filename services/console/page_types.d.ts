// Records of the server as the scripts of the page receive them, for `deno check`. The browser does not load this file.
// docs/specifications/console-api.md describes the fields.

/** Every element of the page is HTML or SVG. */
interface Element extends HTMLOrSVGElement {}

type Verdict = "mine_like" | "not_mine_like" | "unsure";
type Review = Verdict | "disputed" | "unreviewed";

/** [row, column] of an image, or [x, y] in pixels or metres. */
type Point = [number, number];

/** Delivery of a decision to the shore site and to the vehicle. */
interface Delivery {
  shore: string;
  vehicle: string;
  reason: string;
  times_sent: number;
  changed_utc_s: number;
}

/** A contact as in lists and in the event `contact`. */
interface Contact {
  id: string;
  name: string;
  vessel_id: string;
  vehicle_id: string;
  image_id: string;
  revision: number;
  version: number;
  review: Review;
  mlo_class: string | null;
  confidence: number | null;
  decided_by: string | null;
  decided_utc_s: number | null;
  atd_class: string | null;
  atd_confidence: number | null;
  p_mine_like: number | null;
  p_other_object: number | null;
  lat_deg: number | null;
  lon_deg: number | null;
  position_sigma_m: number | null;
  range_m: number | null;
  seen_utc_s: number | null;
  first_frame_utc_s: number;
  bytes_received: number;
  bytes_total: number;
  height_px: number;
  width_px: number;
  complete: boolean;
  percent_received: number | null;
  stage: "record" | "preview" | "part" | "sent" | "refined";
  has_image: boolean;
  looks: number;
  object: string | null;
  contradictory: boolean;
  decided_on: { version: number; bytes: number | null } | null;
  newer_detail: boolean;
  commented: boolean;
  delivery: Delivery | null;
  open_requests: number;
  authenticated: boolean | null;
  known: { label: string; is_mine_like: boolean } | null;
}

/** A version of the image of a contact. */
interface Version {
  version: number;
  codec: string;
  model: string;
  complete: boolean;
  missing_fraction: number;
  bytes_received: number;
  bytes_total: number;
  first_frame_utc_s: number;
  authenticated: boolean | null;
  despeckle_strength: number | null;
  received_utc_s: number;
  height_px: number;
  width_px: number;
  sha256: string;
  percent_received: number | null;
  stage: Contact["stage"];
  frames_received: number | null;
  sharp_to_m: number | null;
  airtime_s: number | null;
  airtime_is: "estimated" | "at_least" | null;
  pixel_along_m: number | null;
  pixel_across_m: number | null;
  range_axis: "slant" | "ground" | null;
  mark: ImageMark | null;
  box: { rows: [number, number]; columns: [number, number] } | null;
  notes: string[];
  texture: "codebook" | null;
  texture_edge_px: number | null;
}

/** Place of a contact in its image. */
interface ImageMark {
  row: number;
  column: number;
  columns: [number, number];
  range_m: number;
}

/** An operator's decision. */
interface Decision {
  decision_id: string;
  verdict: Verdict;
  confidence: number | null;
  mlo_class: string | null;
  remark: string;
  operator: string;
  decided_utc_s: number;
  version: number;
  sha256: string | null;
  layer: string | null;
  undoes: string | null;
  undone: boolean;
  overrules: string[];
  take_back_utc_s: number | null;
  elsewhere: boolean;
  delivery: Delivery;
}

/** A request to the vehicle. */
interface VehicleRequest {
  command_id: string;
  kind: string;
  user: string;
  asked_utc_s: number;
  airtime_s: number | null;
  state: string;
  times_sent: number;
  reason: string;
  changed_utc_s: number;
  bytes_wanted: number | null;
  probable_utc_s: number | null;
  expected_utc_s: number | null;
  late_utc_s: number | null;
  arrived_utc_s: number | null;
  result: { id: string; version: number; bytes: number } | null;
}

/** All data of a contact. */
interface ContactDetail {
  contact: Contact;
  record: Record<string, any> | null;
  further: Record<string, string | number | boolean>;
  versions: Version[];
  related: any[];
  decisions: Decision[];
  standing: string[];
  comments: any[];
  requests: VehicleRequest[];
  measurements: any[];
  size: Record<string, any>;
  group: Contact[];
  truth: any;
  earlier: Contact[];
  audit: any[];
  costs: any[];
}
