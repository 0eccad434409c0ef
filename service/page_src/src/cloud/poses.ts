// cloud.json: cameras and trajectories, before and after.

import { Matrix4, Vector3 } from "three";

import type { Octree } from "./octree";

/** Upper three rows of a 4 x 4 transform, row by row. */
export type Pose = number[];

export interface PosePairs {
  times: number[];
  /** Expected error of each refined position, m; null where, or if, it is not known. */
  error?: (number | null)[] | null;
  rough: Pose[];
  refined: Pose[];
}

export interface CloudFacts {
  schema: number;
  octree: string;
  camera: { width: number; height: number; fx: number; fy: number; cx: number; cy: number } | null;
  parts?: [number, number][];
  scans: PosePairs;
  images: (PosePairs & { names: string[]; pictures: number[] }) | null;
}

export function matrix(pose: Pose): Matrix4 {
  const at = (i: number): number => pose[i] ?? 0;
  return new Matrix4().set(
    at(0), at(1), at(2), at(3), at(4), at(5), at(6), at(7), at(8), at(9), at(10), at(11), 0, 0, 0, 1,
  );
}

/** World to the viewer's frame, whose origin is the octree's: small numbers, which the graphics card can hold. */
export function local(pose: Pose, origin: Vector3): Matrix4 {
  return matrix(pose).premultiply(new Matrix4().makeTranslation(origin.clone().negate()));
}

/** Rough from refined place of the points of each scan, three rows of four numbers, in the viewer's frame. */
export function roughFromRefined(scans: PosePairs, origin: Vector3, width: number): Float32Array<ArrayBuffer> {
  const height = Math.max(1, Math.ceil((scans.refined.length * 3) / width));
  const rows = new Float32Array(width * height * 4);
  scans.refined.forEach((refined, s) => {
    const moved = local(scans.rough[s] ?? refined, origin).multiply(local(refined, origin).invert());
    const e = moved.elements;
    for (let r = 0; r < 3; r++) {
      rows.set([e[r] ?? 0, e[4 + r] ?? 0, e[8 + r] ?? 0, e[12 + r] ?? 0], (s * 3 + r) * 4);
    }
  });
  return rows;
}

/** Lines of the frustum of a camera: pairs of points in its frame, as far away as `depth`. */
export function frustumLines(camera: NonNullable<CloudFacts["camera"]>, depth: number): Vector3[] {
  const corner = (u: number, v: number): Vector3 =>
    new Vector3(((u - camera.cx) / camera.fx) * depth, ((v - camera.cy) / camera.fy) * depth, depth);
  const [w, h] = [camera.width - 0.5, camera.height - 0.5];
  const corners = [corner(-0.5, -0.5), corner(w, -0.5), corner(w, h), corner(-0.5, h)];
  const lines: Vector3[] = [];
  corners.forEach((one, i) => {
    lines.push(new Vector3(), one, one, corners[(i + 1) % 4] ?? one);
  });
  const top = (x: number, y: number): Vector3 => corner(camera.width * x, camera.height * y);
  return [...lines, top(0.35, -0.02), top(0.5, -0.2), top(0.5, -0.2), top(0.65, -0.02)]; // which side is up
}

/** What is worth looking at first: the map round the path of the scanner, for a few far points may make the map much larger. */
export function region(octree: Octree, facts: CloudFacts | null, origin: Vector3): { center: Vector3; radius: number; along: Vector3 } {
  const bounds = octree.bounds();
  const [low, high] = [new Vector3(...bounds.low), new Vector3(...bounds.high)];
  const span = high.clone().sub(low);
  const whole = Math.max(0.5, Math.hypot(span.x, span.y) / 2);
  const path = (facts?.scans.refined ?? []).map((pose) => new Vector3().setFromMatrixPosition(local(pose, origin)));
  if (path.length < 2) {
    return { center: low.add(high).multiplyScalar(0.5), radius: whole, along: span.x > span.y ? new Vector3(1, 0, 0) : new Vector3(0, 1, 0) };
  }
  const center = path.reduce((sum, one) => sum.add(one), new Vector3()).divideScalar(path.length);
  const away = path.map((one) => one.clone().sub(center));
  const reach = Math.max(...away.map((one) => Math.hypot(one.x, one.y)));
  const moment = (f: (one: Vector3) => number): number => away.reduce((sum, one) => sum + f(one), 0);
  const angle = 0.5 * Math.atan2(2 * moment((one) => one.x * one.y), moment((one) => one.x ** 2 - one.y ** 2));
  return { center, radius: Math.min(whole, 1.15 * reach + 0.25 * whole), along: new Vector3(Math.cos(angle), Math.sin(angle), 0) };
}
