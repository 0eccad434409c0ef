// What the server says, as docs/rest.md has it. Unknown fields are ignored.

export type JobState = "queued" | "running" | "canceling" | "done" | "failed" | "canceled";
export type StageState = "waiting" | "running" | "done" | "failed" | "stopped";

export interface Stage {
  name: string;
  state: StageState;
  reused: boolean;
  what: string | null;
  done: number | null;
  total: number | null;
  seconds: number | null;
  eta_s: number | null;
  peak_memory_mb: number | null;
}

export interface Attempt {
  number: number;
  started: string;
  finished: string | null;
  outcome: string | null;
  message: string | null;
}

export interface JobError {
  code: string;
  stage?: string | null;
  cause: string;
  hint: string;
  /** Of a recording that is not valid: the file or folder in it that is meant. */
  path?: string | null;
}

export interface Estimate {
  seconds: number | null;
  memory_bytes: number | null;
  disk_bytes: number | null;
  basis?: string;
  warnings?: string[];
}

export interface Summary {
  psnr_before: number | null;
  psnr_after: number | null;
  entropy_before: number | null;
  entropy_after: number | null;
  accepted_scans: boolean | null;
  accepted_cameras: boolean | null;
  /** Missing in jobs of earlier versions. */
  verdict?: Level | null;
  map_error_m?: number | null;
}

export interface Job {
  id: string;
  name: string;
  dataset: string;
  batch: string | null;
  config: Record<string, unknown> | null;
  priority: number;
  reference: boolean;
  /** Choices of the import of a bag. */
  import?: Record<string, unknown> | null;
  state: JobState;
  created: string;
  started: string | null;
  finished: string | null;
  position?: number | null;
  progress: number;
  eta_s: number | null;
  elapsed_s: number | null;
  stages?: Stage[];
  attempts?: Attempt[];
  error: JobError | null;
  estimate?: Estimate | null;
  summary?: Summary | null;
  log_bytes?: number;
}

export interface Dataset {
  id: string;
  name: string;
  state: "uploading" | "validating" | "ready" | "invalid";
  source: "upload" | "folder";
  created: string;
  bytes: number;
  files: number;
  error: JobError | null;
  facts: {
    scans: number;
    images: number;
    width?: number | null;
    height?: number | null;
    duration_s: number;
    warnings?: string[];
    has_reference?: boolean;
    /** Of what a job imports first; null or missing: it is a recording. */
    format?: string | null;
  } | null;
}

/** A topic, and what its first records say; what is not known is missing. */
export interface StreamFacts {
  name: string;
  kind: string;
  type: string;
  count: number | null;
  rate: number | null;
  first: number | null;
  last: number | null;
  problem: string;
  points?: number;
  width?: number;
  height?: number;
  stored?: string;
  times?: string;
  time_field?: string;
  time_unit?: string;
  sweep_s?: number;
  stamp_is?: string;
  lens?: string;
  child?: string;
  acceleration_unit?: string;
  transforms?: string[];
}

export interface Inspection {
  format: string;
  size: number;
  streams: StreamFacts[];
  notes: string[];
  missing: string[];
  presets: string[];
  choice: { lidar: string; image: string; odometry: string; imu: string };
  /** Files that may be calibrations or poses. */
  beside?: string[];
}

export interface UploadedFile {
  path: string;
  length: number | null;
  received: number;
  complete: boolean;
  sha256?: string | null;
}

export interface Batch {
  id: string;
  name: string;
  created: string;
  counts: Partial<Record<JobState, number>>;
  progress: number;
  jobs?: Job[];
}

export interface Page<T> {
  items: T[];
  next: string | null;
}

export interface Artifact {
  name: string;
  bytes: number;
  media_type: string;
  modified: string;
  url: string;
}

export interface Frame {
  index: number;
  time: number;
  /** Of the image's file; the last part of `raw` where it is not known. */
  name?: string;
  raw: string | null;
  before: string | null;
  after: string | null;
}

export interface LogPiece {
  from: number;
  next: number;
  size: number;
  text: string;
  ended: boolean;
}

export interface Me {
  owner: string;
  scopes: string[];
  auth: boolean;
  /** Only from `lvba view`: there is this one result, and nothing else. */
  result?: { name: string };
  quota?: { bytes: number | null; bytes_used: number } | null;
}

export interface Info {
  version: string;
  disk_free_bytes: number;
  queued: number;
  running: number;
  roots?: string[];
  limits?: Record<string, number | null>;
}

/** A part of a JSON Schema, as far as the options form reads it. */
export interface Schema {
  type?: string | string[];
  title?: string;
  description?: string;
  default?: unknown;
  enum?: unknown[];
  anyOf?: Schema[];
  properties?: Record<string, Schema>;
  items?: Schema;
  minimum?: number;
  maximum?: number;
  level?: "basic" | "advanced";
  unit?: string;
  meaning?: string;
  range?: string;
  change_when?: string;
  $ref?: string;
  $defs?: Record<string, Schema>;
}

export interface Options {
  schema: Schema;
  defaults: Record<string, unknown>;
}

/** What `/v1/options` answers. */
export interface AllOptions extends Options {
  /** Of the import of a bag. */
  import: Options;
}

export interface ScoresFacts {
  psnr_leave_one_out?: number | null;
  ssim_leave_one_out?: number | null;
  map_entropy?: number | null;
  images?: number[];
  per_image?: Record<string, (number | null)[]>;
}

export interface ExpectedError {
  position_m: number | null;
  position_p95_m: number | null;
  rotation_deg?: number | null;
  per_frame_m?: (number | null)[];
}

export type Level = "good" | "check" | "bad";

/** report.json, as far as the page reads it. */
export interface Report {
  verdict?: { level: Level; summary: string; reasons: { text: string; mend: string }[] };
  expected_error?: { map: ExpectedError | null; scans: ExpectedError | null; cameras: ExpectedError | null; at_least?: boolean; note?: string };
  planes?: { thickness_before_m: number | null; thickness_after_m: number | null };
  dataset?: { scans?: number; images?: number; path_length_m?: number; duration_s?: number };
  lidar?: { accepted?: boolean | null; reason?: string };
  visual?: { accepted?: boolean | null; reason?: string; exposures_accepted?: boolean | null; exposures_reason?: string; state?: string };
  fusion?: { accepted?: boolean | null; reason?: string };
  exposure?: { times?: number[]; relative?: (number | null)[]; reference?: (number | null)[] };
  evaluation?: { rough?: ScoresFacts; refined?: ScoresFacts; states?: Record<string, ScoresFacts> };
  reference?: {
    lidar?: { ate_m?: number | null };
    camera?: { ate_m?: number | null };
    rough?: { lidar?: { ate_m?: number | null }; camera?: { ate_m?: number | null } };
  };
  warnings?: string[];
}
