// The octree of a map as it lies on the server (Potree 2 layout), and what of it is in memory.

import { request } from "../api";

interface Attribute {
  name: string;
  size: number;
  numElements: number;
  elementSize: number;
  type: string;
  min: number[];
  max: number[];
}

interface Metadata {
  points: number;
  offset: [number, number, number];
  scale: [number, number, number];
  spacing: number;
  boundingBox: { min: [number, number, number]; max: [number, number, number] };
  hierarchy: { firstChunkSize: number };
  attributes: Attribute[];
}

export interface OctreeNode {
  name: string;
  level: number;
  /** Low corner of its cube, from the octree's offset, m. */
  low: [number, number, number];
  edge: number;
  points: number;
  offset: number;
  bytes: number;
  children: (OctreeNode | null)[];
}

const NODE_BYTES = 22;
/** Stands for no value: the shader shows it gray. */
const NONE = 1e30;

export class Octree {
  readonly stride: number;
  /** First scan and one after the last of each part of the recording, in order; empty where it was not cut. */
  parts: [number, number][] = [];
  private readonly places = new Map<string, { at: number; attribute: Attribute }>();

  private constructor(
    readonly metadata: Metadata,
    readonly root: OctreeNode,
    private readonly url: (name: string) => string,
  ) {
    let at = 0;
    for (const attribute of metadata.attributes) {
      this.places.set(attribute.name, { at, attribute });
      at += attribute.size;
    }
    this.stride = at;
  }

  static async open(url: (name: string) => string): Promise<Octree> {
    const metadata = (await (await request(url("metadata.json"))).json()) as Metadata;
    const table = new DataView(await (await request(url("hierarchy.bin"))).arrayBuffer());
    return new Octree(metadata, readHierarchy(table, metadata), url);
  }

  get edge(): number {
    return this.metadata.boundingBox.max[0] - this.metadata.boundingBox.min[0];
  }

  /** Least and greatest value of an attribute, or null where the map has none. */
  range(name: string): [number, number] | null {
    if (this.isByScan(name)) return [0, this.parts.length - 1];
    const place = this.places.get(name);
    return place === undefined ? null : [place.attribute.min[0] ?? 0, place.attribute.max[0] ?? 0];
  }

  /** Corners of the points (not of the cube), from the octree's offset, m. */
  bounds(): { low: [number, number, number]; high: [number, number, number] } {
    const place = this.places.get("position");
    const { offset } = this.metadata;
    const from = (values: number[] | undefined, a: 0 | 1 | 2): number => (values?.[a] ?? 0) - offset[a];
    const { min, max } = place?.attribute ?? {};
    return { low: [from(min, 0), from(min, 1), from(min, 2)], high: [from(max, 0), from(max, 1), from(max, 2)] };
  }

  /** The bytes of a node. */
  async load(node: OctreeNode, signal: AbortSignal): Promise<DataView> {
    if (node.bytes === 0) return new DataView(new ArrayBuffer(0));
    const range = `bytes=${String(node.offset)}-${String(node.offset + node.bytes - 1)}`;
    const response = await request(this.url("octree.bin"), { headers: { Range: range }, signal });
    const content = await response.arrayBuffer();
    // a server that knows no ranges sends everything
    return response.status === 206 ? new DataView(content) : new DataView(content, node.offset, node.bytes);
  }

  /** Positions (3 per point) from the node's low corner, m. */
  positions(node: OctreeNode, data: DataView): Float32Array {
    const at = this.places.get("position")?.at ?? 0;
    const out = new Float32Array(node.points * 3);
    for (let i = 0; i < node.points; i++) {
      for (let a = 0; a < 3; a++) {
        const steps = data.getInt32(i * this.stride + at + 4 * a, true);
        out[3 * i + a] = steps * (this.metadata.scale[a] ?? 0) - (node.low[a] ?? 0);
      }
    }
    return out;
  }

  /** Colors (3 per point), 8 bits. */
  colors(node: OctreeNode, data: DataView): Uint8Array {
    const at = this.places.get("rgb")?.at ?? 0;
    const out = new Uint8Array(node.points * 3);
    for (let i = 0; i < node.points; i++) {
      for (let a = 0; a < 3; a++) out[3 * i + a] = data.getUint16(i * this.stride + at + 2 * a, true) >> 8;
    }
    return out;
  }

  /** Whether the part of a point follows from its scan. */
  private isByScan(name: string): boolean {
    return name === "part" && !this.places.has("part") && this.places.has("scan") && this.parts.length > 1;
  }

  /** One number per point; zeros where the map has no such attribute. */
  values(node: OctreeNode, data: DataView, name: string): Float32Array {
    if (this.isByScan(name)) {
      return this.values(node, data, "scan").map((scan) => this.parts.findIndex(([, end]) => scan < end));
    }
    const out = new Float32Array(node.points);
    const place = this.places.get(name);
    if (place === undefined) return out;
    const read = reader(data, place.attribute.type);
    for (let i = 0; i < node.points; i++) {
      const value = read(i * this.stride + place.at);
      out[i] = Number.isNaN(value) ? NONE : value;
    }
    return out;
  }
}

function reader(data: DataView, type: string): (at: number) => number {
  switch (type) {
    case "uint8":
      return (at) => data.getUint8(at);
    case "int8":
      return (at) => data.getInt8(at);
    case "uint16":
      return (at) => data.getUint16(at, true);
    case "int16":
      return (at) => data.getInt16(at, true);
    case "uint32":
      return (at) => data.getUint32(at, true);
    case "int32":
      return (at) => data.getInt32(at, true);
    case "float":
      return (at) => data.getFloat32(at, true);
    case "double":
      return (at) => data.getFloat64(at, true);
    default:
      return () => 0;
  }
}

function readHierarchy(table: DataView, metadata: Metadata): OctreeNode {
  const edge = metadata.boundingBox.max[0] - metadata.boundingBox.min[0];
  const root = empty("r", 0, [0, 0, 0], edge);
  const nodes = [root];
  for (let place = 0; place < nodes.length; place++) {
    const node = nodes[place];
    if (node === undefined) break;
    const at = place * NODE_BYTES;
    const mask = table.getUint8(at + 1);
    node.points = table.getUint32(at + 2, true);
    node.offset = Number(table.getBigUint64(at + 6, true));
    node.bytes = Number(table.getBigUint64(at + 14, true));
    for (let child = 0; child < 8; child++) {
      if ((mask >> child) & 1) nodes.push(addChild(node, child));
    }
  }
  return root;
}

function addChild(parent: OctreeNode, child: number): OctreeNode {
  const edge = parent.edge / 2;
  const low = parent.low.map((x, a) => x + edge * ((child >> (2 - a)) & 1)) as [number, number, number];
  const node = empty(parent.name + String(child), parent.level + 1, low, edge);
  parent.children[child] = node;
  return node;
}

function empty(name: string, level: number, low: [number, number, number], edge: number): OctreeNode {
  return { name, level, low, edge, points: 0, offset: 0, bytes: 0, children: [null, null, null, null, null, null, null, null] };
}
