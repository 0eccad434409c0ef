// Which nodes to show: what is in view, what looks largest first, until the budget of points is spent.

import { Box3, Frustum, Matrix4, type PerspectiveCamera, Vector3 } from "three";

import type { OctreeNode } from "./octree";

/** A node whose points are nearer together than this on the screen needs no children, px. */
const FINE_ENOUGH_PX = 1.3;

export interface Choice {
  /** In memory, to be drawn; a node comes after the one above it. */
  shown: OctreeNode[];
  /** To be loaded, the most wanted first. */
  wanted: OctreeNode[];
}

interface Entry {
  node: OctreeNode;
  weight: number;
}

/** The nodes to show and to load. rootSpacing: distance of the root's points, m; height: of the picture, px. */
export function choose(
  root: OctreeNode,
  rootSpacing: number,
  camera: PerspectiveCamera,
  height: number,
  budget: number,
  loaded: (node: OctreeNode) => boolean,
): Choice {
  const view = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  const frustum = new Frustum().setFromProjectionMatrix(view);
  const pixelsPerRadian = height / (2 * Math.tan((camera.fov * Math.PI) / 360));
  const choice: Choice = { shown: [], wanted: [] };
  const heap: Entry[] = [{ node: root, weight: Infinity }];
  let left = budget;
  while (heap.length > 0) {
    const entry = pop(heap);
    if (entry === undefined || entry.node.points > left) break;
    const { node } = entry;
    left -= node.points;
    if (!loaded(node)) {
      choice.wanted.push(node);
      continue;
    }
    choice.shown.push(node);
    for (const child of node.children) {
      if (child === null || !frustum.intersectsBox(boxOf(child))) continue;
      const distance = Math.max(distanceTo(child, camera.position), 1e-3);
      const spacingPx = ((rootSpacing / 2 ** node.level) * pixelsPerRadian) / distance;
      if (spacingPx > FINE_ENOUGH_PX) push(heap, { node: child, weight: child.edge / distance });
    }
  }
  return choice;
}

function boxOf(node: OctreeNode): Box3 {
  const low = new Vector3(...node.low);
  return new Box3(low, low.clone().addScalar(node.edge));
}

function distanceTo(node: OctreeNode, position: Vector3): number {
  return boxOf(node).distanceToPoint(position);
}

function push(heap: Entry[], entry: Entry): void {
  let at = heap.length;
  heap.push(entry);
  while (at > 0) {
    const above = (at - 1) >> 1;
    const parent = heap[above];
    if (parent === undefined || parent.weight >= entry.weight) break;
    heap[at] = parent;
    at = above;
  }
  heap[at] = entry;
}

function pop(heap: Entry[]): Entry | undefined {
  const top = heap[0];
  const last = heap.pop();
  if (last === undefined || heap.length === 0) return top;
  let at = 0;
  for (;;) {
    let below = 2 * at + 1;
    const left = heap[below];
    if (left === undefined) break;
    const right = heap[below + 1];
    if (right !== undefined && right.weight > left.weight) below++;
    const larger = heap[below];
    if (larger === undefined || larger.weight <= last.weight) break;
    heap[at] = larger;
    at = below;
  }
  heap[at] = last;
  return top;
}
