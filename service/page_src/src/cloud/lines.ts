// Cameras as frustums, and trajectories, each between its rough and its refined place.

import { BufferAttribute, BufferGeometry, Color, ColorManagement, LineSegments, Line, type Object3D, Points, type ShaderMaterial, Vector3 } from "three";

import { lineMaterial, markMaterial } from "./material";
import { type CloudFacts, frustumLines, local, type PosePairs } from "./poses";

ColorManagement.enabled = false; // colors go to the screen as they are

const CAMERA = new Color("#ffb000");
const CHOSEN = new Color("#ff3d7f");
const BEFORE = new Color("#ff7a45");
const AFTER = new Color("#19c3b5");
const UNKNOWN = new Color("#808080");

/** The colors of frames by an amount: 256 RGBA colors from 0 to `most`, gray where it is not known. */
export interface Paint {
  ramp: Uint8Array;
  most: number;
}

function painted(paint: Paint, value: number | null | undefined): Color {
  if (value === null || value === undefined) return UNKNOWN;
  const at = 4 * Math.round(255 * Math.min(1, Math.max(0, value / paint.most)));
  return new Color((paint.ramp[at] ?? 0) / 255, (paint.ramp[at + 1] ?? 0) / 255, (paint.ramp[at + 2] ?? 0) / 255);
}

function positions(pairs: PosePairs, which: "rough" | "refined", origin: Vector3): Vector3[] {
  return pairs[which].map((pose) => new Vector3().setFromMatrixPosition(local(pose, origin)));
}

function flat(points: Vector3[]): BufferAttribute {
  return new BufferAttribute(new Float32Array(points.flatMap((p) => [p.x, p.y, p.z])), 3);
}

/** The frustums of all cameras. */
export class Cameras {
  readonly object: LineSegments<BufferGeometry, ShaderMaterial>;
  readonly refined: Vector3[];
  readonly rough: Vector3[];
  readonly size: number;
  private readonly perCamera: number;
  private readonly errors: (number | null)[];
  private chosen: number | null = null;
  private paint: Paint | null = null;

  constructor(facts: CloudFacts, origin: Vector3) {
    const images: PosePairs = facts.images ?? { times: [], rough: [], refined: [] };
    this.errors = images.error ?? [];
    this.refined = positions(images, "refined", origin);
    this.rough = positions(images, "rough", origin);
    this.size = frustumSize(this.refined);
    const lines = facts.camera === null ? [] : frustumLines(facts.camera, this.size);
    this.perCamera = lines.length;
    const placed = (which: "rough" | "refined"): Vector3[] =>
      images[which].flatMap((pose) => {
        const world = local(pose, origin);
        return lines.map((point) => point.clone().applyMatrix4(world));
      });
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", flat(placed("refined")));
    geometry.setAttribute("rough", flat(placed("rough")));
    geometry.setAttribute("tint", new BufferAttribute(new Float32Array(this.refined.length * lines.length * 3), 3));
    this.object = new LineSegments(geometry, lineMaterial());
    this.object.frustumCulled = false;
    this.choose(null);
  }

  /** Marks one camera. */
  choose(image: number | null): void {
    this.chosen = image;
    this.color();
  }

  /** Colors cameras by their expected errors; null: all alike. */
  setPaint(paint: Paint | null): void {
    this.paint = paint;
    this.color();
  }

  private color(): void {
    const tint = this.object.geometry.getAttribute("tint") as BufferAttribute;
    const own = this.refined.map((_, image) => (this.paint === null ? CAMERA : painted(this.paint, this.errors[image])));
    for (let i = 0; i < tint.count; i++) {
      const image = Math.floor(i / this.perCamera);
      const color = image === this.chosen ? CHOSEN : (own[image] ?? CAMERA);
      tint.setXYZ(i, color.r, color.g, color.b);
    }
    tint.needsUpdate = true;
  }
}

/** Frustums that don't hide each other: two thirds of the usual distance of two cameras. */
function frustumSize(centers: Vector3[]): number {
  const steps = centers.slice(1).map((center, i) => center.distanceTo(centers[i] ?? center)).sort((a, b) => a - b);
  const median = steps[Math.floor(steps.length / 2)] ?? 0.5;
  return Math.min(1.5, Math.max(0.12, 0.66 * median));
}

/** The path of the scanner: rough and refined. */
export function trajectories(facts: CloudFacts, origin: Vector3): Line<BufferGeometry, ShaderMaterial>[] {
  return (["rough", "refined"] as const).map((which) => {
    const points = flat(positions(facts.scans, which, origin));
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", points);
    geometry.setAttribute("rough", points);
    const color = which === "rough" ? BEFORE : AFTER;
    const tint = new Float32Array(points.count * 3);
    for (let i = 0; i < points.count; i++) tint.set([color.r, color.g, color.b], 3 * i);
    geometry.setAttribute("tint", new BufferAttribute(tint, 3));
    const line = new Line(geometry, lineMaterial());
    line.frustumCulled = false;
    return line;
  });
}

/** Where scans were taken, as points in the colors of their expected errors; null where none is known. */
export class ErrorMarks {
  readonly object: Object3D;
  private readonly tint: BufferAttribute;

  private constructor(places: BufferAttribute, private readonly errors: (number | null)[]) {
    const geometry = new BufferGeometry();
    this.tint = new BufferAttribute(new Float32Array(places.count * 3), 3);
    geometry.setAttribute("position", places);
    geometry.setAttribute("rough", places);
    geometry.setAttribute("tint", this.tint);
    this.object = new Points(geometry, markMaterial());
    this.object.frustumCulled = false;
  }

  static of(facts: CloudFacts, origin: Vector3): ErrorMarks | null {
    const { error } = facts.scans;
    return error === null || error === undefined ? null : new ErrorMarks(flat(positions(facts.scans, "refined", origin)), error);
  }

  setPaint(paint: Paint): void {
    for (let i = 0; i < this.tint.count; i++) {
      const color = painted(paint, this.errors[i]);
      this.tint.setXYZ(i, color.r, color.g, color.b);
    }
    this.tint.needsUpdate = true;
  }
}
