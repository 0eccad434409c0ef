// Nodes in memory: fetched a few at a time, decoded, drawn, and forgotten again when others are wanted more.

import { BufferAttribute, BufferGeometry, Points, type ShaderMaterial } from "three";

import { NODES_WIDTH } from "./material";
import type { Octree, OctreeNode } from "./octree";
import type { ColorBy } from "./palette";

const AT_ONCE = 6;
/** Points kept in memory for each point that may be shown. */
const KEPT = 2.5;

interface Loaded {
  data: DataView;
  points: Points<BufferGeometry, ShaderMaterial>;
  colored: ColorBy | null;
  used: number;
}

export class Nodes {
  private readonly loaded = new Map<OctreeNode, Loaded>();
  private readonly loading = new Map<OctreeNode, AbortController>();
  private readonly failed = new Map<OctreeNode, number>();
  private clock = 0;

  constructor(
    private readonly octree: Octree,
    private readonly material: ShaderMaterial,
    private readonly changed: () => void,
  ) {}

  has(node: OctreeNode): boolean {
    return this.loaded.has(node);
  }

  get busy(): boolean {
    return this.loading.size > 0;
  }

  /** Fetches the most wanted nodes; what is no longer wanted is not fetched any more. */
  want(nodes: OctreeNode[]): void {
    const ready = nodes.filter((node) => (this.failed.get(node) ?? 0) < performance.now());
    const wanted = new Set(ready.slice(0, 4 * AT_ONCE));
    for (const [node, stop] of this.loading) if (!wanted.has(node)) stop.abort();
    for (const node of ready) {
      if (this.loading.size >= AT_ONCE) return;
      if (!this.loading.has(node)) void this.fetch(node);
    }
  }

  private async fetch(node: OctreeNode): Promise<void> {
    const stop = new AbortController();
    this.loading.set(node, stop);
    try {
      const data = await this.octree.load(node, stop.signal);
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(this.octree.positions(node, data), 3));
      geometry.setAttribute("rgb", new BufferAttribute(this.octree.colors(node, data), 3, true));
      geometry.setAttribute("scan", new BufferAttribute(this.octree.values(node, data, "scan"), 1));
      const points = new Points(geometry, this.material);
      points.frustumCulled = false; // `choose` did that
      points.matrixAutoUpdate = false;
      this.loaded.set(node, { data, points, colored: null, used: this.clock });
    } catch {
      if (!stop.signal.aborted) this.failed.set(node, performance.now() + 3000);
    } finally {
      this.loading.delete(node);
      this.changed();
    }
  }

  /** What to draw for the shown nodes, colored as wanted. */
  draw(shown: OctreeNode[], by: ColorBy): Points<BufferGeometry, ShaderMaterial>[] {
    this.clock++;
    return shown.map((node, place) => {
      const entry = this.loaded.get(node);
      if (entry === undefined) throw new Error(`node ${node.name} is not in memory`);
      entry.used = this.clock;
      this.color(node, entry, by);
      entry.points.onBeforeRender = () => {
        const { uniforms } = this.material;
        set(uniforms["nodePlace"], place);
        set(uniforms["nodeEdge"], node.edge);
        set(uniforms["nodeLow"], node.low);
        this.material.uniformsNeedUpdate = true;
      };
      return entry.points;
    });
  }

  private color(node: OctreeNode, entry: Loaded, by: ColorBy): void {
    if (entry.colored === by) return;
    const name = by === "rgb" ? "views" : by; // color needs no value: it tells there whether there is one
    const values = this.octree.values(node, entry.data, name);
    entry.points.geometry.setAttribute("value", new BufferAttribute(values, 1));
    entry.colored = by;
  }

  /** Forgets the nodes that were not shown for longest, where there are too many points. */
  forget(budget: number): void {
    let points = 0;
    for (const node of this.loaded.keys()) points += node.points;
    const byAge = [...this.loaded].filter(([, entry]) => entry.used < this.clock).sort((a, b) => a[1].used - b[1].used);
    for (const [node, entry] of byAge) {
      if (points <= KEPT * budget) return;
      entry.points.geometry.dispose();
      this.loaded.delete(node);
      points -= node.points;
    }
  }

  dispose(): void {
    for (const stop of this.loading.values()) stop.abort();
    for (const entry of this.loaded.values()) entry.points.geometry.dispose();
    this.loaded.clear();
  }
}

function set(uniform: { value: unknown } | undefined, value: unknown): void {
  if (uniform !== undefined) uniform.value = value;
}

/**
 * Per shown node the mask of its shown children with the place of the first of them (children stand together), and, as the
 * bits of a float, how far apart the points are there.
 */
export function table(shown: OctreeNode[]): { order: OctreeNode[]; entries: Uint32Array<ArrayBuffer> } {
  const present = new Set(shown);
  const order = shown.slice(0, 1);
  const masks: number[] = [];
  const crowds = shown.slice(0, 1).map((root) => root.points);
  for (let place = 0; place < order.length; place++) {
    let mask = 0;
    const first = order.length;
    order[place]?.children.forEach((child, corner) => {
      if (child === null || !present.has(child)) return;
      mask |= 1 << corner;
      order.push(child);
      crowds.push(child.points + (crowds[place] ?? 0) / 4); // a surface through a cube is in four of its eight parts
    });
    masks.push((mask | (first << 8)) >>> 0);
  }
  const entries = new Uint32Array(2 * Math.max(1, Math.ceil(order.length / NODES_WIDTH)) * NODES_WIDTH);
  const spacings = new Float32Array(entries.buffer);
  order.forEach((node, place) => {
    entries[2 * place] = masks[place] ?? 0;
    spacings[2 * place + 1] = spacing(node.edge, crowds[place] ?? 0);
  });
  return { order, entries };
}

/** Of points on a surface through a cube; never more than a 32nd of the cube, for few points are a corner of one. */
function spacing(edge: number, points: number): number {
  return Math.min(edge / 32, edge / Math.sqrt(Math.max(1, points)));
}
