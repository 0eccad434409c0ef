// The map in 3D: draws what `choose` chooses, only when something changed.

import {
  DepthTexture, Mesh, PerspectiveCamera, PlaneGeometry, Scene, type Texture, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

import { choose } from "./choose";
import { Cameras, ErrorMarks, trajectories } from "./lines";
import { nodesTexture, paletteTexture, pointMaterial, SCANS_WIDTH, scansTexture, screenMaterial } from "./material";
import { Nodes, table } from "./nodes";
import type { Octree } from "./octree";
import { CATEGORIES, type ColorBy, ramp, SIGNED } from "./palette";
import { type CloudFacts, local, region, roughFromRefined } from "./poses";

export interface Looks {
  colorBy: ColorBy;
  rough: boolean;
  onlyColored: boolean;
  cameras: boolean;
  trajectories: boolean;
  size: number;
  budget: number;
}

export interface Status {
  points: number;
  loading: boolean;
}

const MORPH_MS = 700;

export class Viewer {
  private readonly renderer: WebGLRenderer;
  private target = newTarget(1, 1);
  private readonly clouds = new Scene();
  private readonly lines = new Scene();
  private readonly screen = new Scene();
  private readonly camera = new PerspectiveCamera(55, 1, 0.05, 5000);
  private readonly controls: OrbitControls;
  private readonly material = pointMaterial();
  private readonly screenMaterial = screenMaterial();
  private readonly nodes: Nodes;
  private readonly frustums: Cameras | null;
  private readonly paths: ReturnType<typeof trajectories>;
  private readonly marks: ErrorMarks | null;
  private readonly origin: Vector3;
  private readonly resizing: ResizeObserver;
  private looks: Looks;
  private frame = 0;
  /** Where an image was taken, while the view is from there: what is drawn of cameras and paths would lie across it. */
  private standsAt: Vector3 | null = null;
  private morph = { from: 0, to: 0, start: 0 };
  private readonly still = window.matchMedia("(prefers-reduced-motion: reduce)");

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly octree: Octree,
    private readonly facts: CloudFacts | null,
    looks: Looks,
    private readonly tell: (status: Status) => void,
    /** Expected error at the end of its colors, m: what most points stay below; null: the greatest. */
    private mostError: number | null = null,
  ) {
    this.looks = looks;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: "high-performance" });
    this.renderer.autoClear = false;
    this.renderer.setClearColor(0, 0);
    const whole = new Mesh(new PlaneGeometry(2, 2), this.screenMaterial);
    whole.frustumCulled = false; // it is in the screen's own coordinates
    this.screen.add(whole);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", this.redraw);
    this.nodes = new Nodes(octree, this.material, this.redraw);
    this.origin = new Vector3(...octree.metadata.offset);
    this.frustums = facts?.images ? new Cameras(facts, this.origin) : null;
    this.paths = facts === null ? [] : trajectories(facts, this.origin);
    if (this.frustums !== null) this.lines.add(this.frustums.object);
    for (const path of this.paths) this.lines.add(path);
    this.marks = facts === null ? null : ErrorMarks.of(facts, this.origin);
    if (this.marks !== null) this.lines.add(this.marks.object);
    if (facts !== null && octree.range("scan") !== null) {
      this.uniform("rough", scansTexture(roughFromRefined(facts.scans, this.origin, SCANS_WIDTH)));
      this.uniform("hasScans", 1);
    }
    this.resizing = new ResizeObserver(this.redraw);
    this.resizing.observe(canvas);
    this.fit();
    this.setLooks(looks);
  }

  /** Whether rough and refined can be shown one at a time. */
  get hasRough(): boolean {
    return this.facts !== null && this.octree.range("scan") !== null;
  }

  setLooks(looks: Looks): void {
    if (looks.rough !== this.looks.rough && !this.still.matches) {
      this.morph = { from: this.toRough(), to: looks.rough ? 1 : 0, start: performance.now() };
    } else if (looks.rough !== this.looks.rough) {
      this.morph = { from: looks.rough ? 1 : 0, to: looks.rough ? 1 : 0, start: 0 };
    }
    this.looks = looks;
    const mode = looks.colorBy === "rgb" ? 0 : looks.colorBy === "height" ? 1 : CATEGORIES.has(looks.colorBy) ? 3 : 2;
    this.uniform("colorBy", mode);
    const [low, high] = this.range(looks.colorBy);
    this.uniform("range", new Vector2(low, high));
    (this.material.uniforms["palette"]?.value as Texture | null)?.dispose();
    this.uniform("palette", paletteTexture(ramp(looks.colorBy)));
    const paint = looks.colorBy === "error" ? { ramp: ramp("error"), most: high } : null;
    this.frustums?.setPaint(paint);
    if (paint !== null) this.marks?.setPaint(paint);
    this.uniform("sizeFactor", looks.size);
    this.uniform("onlyColored", looks.onlyColored && this.octree.range("views") !== null ? 1 : 0);
    this.redraw();
  }

  /** The values that the palette spans, in the map's unit, from the viewer's origin for heights. */
  range(by: ColorBy): [number, number] {
    if (by === "rgb") return [0, 1];
    if (by === "height") {
      const { low, high } = this.octree.bounds();
      return [low[2], high[2]];
    }
    const [low, high] = this.octree.range(by) ?? [0, 1];
    if (by === "error") return [0, this.mostError ?? high];
    if (SIGNED.has(by)) {
      const most = Math.min(0.05, Math.max(Math.abs(low), Math.abs(high)));
      return [-most, most];
    }
    return by === "spread" ? [0, Math.min(high, 40)] : [low, high];
  }

  setMostError(most: number | null): void {
    this.mostError = most;
    this.setLooks(this.looks);
  }

  choose(image: number | null): void {
    this.frustums?.choose(image);
    this.redraw();
  }

  /** The map in view, from above, across the way that was walked or driven. */
  fit(): void {
    const { center, radius, along } = region(this.octree, this.facts, this.origin);
    const side = new Vector3(-along.y, along.x, 0).addScaledVector(along, 0.3).normalize();
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(side, -radius * 0.95);
    this.camera.position.z += radius * 0.95;
    this.camera.near = Math.max(0.02, radius / 2000);
    this.camera.far = radius * 100 + 200;
    this.controls.update();
    this.redraw();
  }

  /** Looks from where an image was taken. */
  flyTo(image: number): void {
    const pose = this.facts?.images?.[this.looks.rough ? "rough" : "refined"][image];
    if (pose === undefined) return;
    const world = local(pose, this.origin);
    const center = new Vector3().setFromMatrixPosition(world);
    const ahead = new Vector3(0, 0, 1).transformDirection(world);
    this.camera.position.copy(center).addScaledVector(ahead, -0.02);
    this.standsAt = center;
    this.canvas.scrollIntoView({ block: "nearest" });
    this.controls.target.copy(center).addScaledVector(ahead, 3);
    this.controls.update();
    this.redraw();
  }

  /** Turns round the target (radians), or comes nearer (factor below 1), or moves sideways (parts of the distance). */
  turn(azimuth: number, polar: number, nearer = 1, right = 0, up = 0): void {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const distance = offset.length() * nearer;
    const pole = Math.min(Math.PI - 0.02, Math.max(0.02, Math.acos(offset.z / offset.length()) + polar));
    const around = Math.atan2(offset.y, offset.x) + azimuth;
    const aside = new Vector3(-Math.sin(around), Math.cos(around), 0).multiplyScalar(right * distance);
    this.controls.target.add(aside).add(new Vector3(0, 0, up * distance));
    offset.set(Math.sin(pole) * Math.cos(around), Math.sin(pole) * Math.sin(around), Math.cos(pole)).multiplyScalar(distance);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.redraw();
  }

  /** The image whose camera is drawn nearest to a place on the canvas, px; null where none is near. */
  cameraAt(x: number, y: number): number | null {
    if (this.frustums === null || !this.looks.cameras || this.standsAt !== null) return null;
    const places = this.looks.rough ? this.frustums.rough : this.frustums.refined;
    let best: number | null = null;
    let least = 16;
    places.forEach((place, image) => {
      const seen = place.clone().project(this.camera);
      if (seen.z > 1) return;
      const away = Math.hypot(((seen.x + 1) / 2) * this.canvas.clientWidth - x, ((1 - seen.y) / 2) * this.canvas.clientHeight - y);
      if (away < least) [best, least] = [image, away];
    });
    return best;
  }

  readonly redraw = (): void => {
    if (this.frame === 0) this.frame = requestAnimationFrame(this.draw);
  };

  private toRough(): number {
    const part = this.morph.start === 0 ? 1 : Math.min(1, (performance.now() - this.morph.start) / MORPH_MS);
    const eased = part * part * (3 - 2 * part);
    return this.morph.from + (this.morph.to - this.morph.from) * eased;
  }

  /** Shows cameras and paths as asked for, but not across the view of a camera: until the eye has left its frustum. */
  private showLines(): void {
    const size = this.frustums?.size ?? 0;
    if (this.standsAt !== null && this.standsAt.distanceTo(this.camera.position) > Math.max(size, 0.1)) this.standsAt = null;
    if (this.frustums !== null) this.frustums.object.visible = this.looks.cameras && this.standsAt === null;
    const paths = this.looks.trajectories && this.standsAt === null;
    for (const path of this.paths) path.visible = paths;
    // marks are where the refined scans are
    if (this.marks !== null) this.marks.object.visible = paths && this.looks.colorBy === "error" && !this.looks.rough;
  }

  private readonly draw = (): void => {
    this.frame = 0;
    if (!this.fitSize()) return;
    this.showLines();
    const toRough = this.toRough();
    this.uniform("toRough", toRough);
    if (this.frustums !== null) setUniform(this.frustums.object.material, "toRough", toRough);
    this.camera.updateMatrixWorld();
    const height = this.target.height;
    const { root, metadata } = this.octree;
    const choice = choose(root, metadata.spacing, this.camera, height, this.looks.budget, (node) => this.nodes.has(node));
    this.nodes.want(choice.wanted);
    const { order, entries } = table(choice.shown);
    (this.material.uniforms["nodes"]?.value as Texture | null)?.dispose();
    this.uniform("nodes", nodesTexture(entries));
    this.uniform("pixelsPerRadian", height / (2 * Math.tan((this.camera.fov * Math.PI) / 360)));
    this.clouds.clear();
    for (const points of this.nodes.draw(order, this.looks.colorBy)) this.clouds.add(points);
    this.render();
    this.nodes.forget(this.looks.budget);
    this.tell({ points: order.reduce((sum, node) => sum + node.points, 0), loading: this.nodes.busy });
    if (toRough !== this.morph.to) this.redraw();
  };

  private render(): void {
    const { uniforms } = this.screenMaterial;
    set(uniforms["picture"], this.target.texture);
    set(uniforms["depth"], this.target.depthTexture);
    set(uniforms["pixel"], new Vector2(1 / this.target.width, 1 / this.target.height));
    set(uniforms["nearFar"], new Vector2(this.camera.near, this.camera.far));
    this.renderer.setRenderTarget(this.target);
    this.renderer.clear();
    this.renderer.render(this.clouds, this.camera);
    this.renderer.setRenderTarget(null);
    this.renderer.clear();
    this.renderer.render(this.screen, this.camera);
    this.renderer.render(this.lines, this.camera);
  }

  /** Takes on the size of the canvas; false where it has none. */
  private fitSize(): boolean {
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth === 0 || clientHeight === 0) return false;
    const ratio = Math.min(window.devicePixelRatio, 2);
    const [width, height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    if (this.target.width !== width || this.target.height !== height) {
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(clientWidth, clientHeight, false);
      this.target.dispose();
      this.target = newTarget(width, height);
      this.camera.aspect = clientWidth / clientHeight;
      this.camera.updateProjectionMatrix();
    }
    return true;
  }

  private uniform(name: string, value: unknown): void {
    setUniform(this.material, name, value);
  }

  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.frame = -1; // nothing is drawn any more
    this.resizing.disconnect();
    this.controls.dispose();
    this.nodes.dispose();
    this.target.dispose();
    this.renderer.dispose();
  }
}

function newTarget(width: number, height: number): WebGLRenderTarget {
  return new WebGLRenderTarget(width, height, { depthTexture: new DepthTexture(width, height) });
}

function set(uniform: { value: unknown } | undefined, value: unknown): void {
  if (uniform !== undefined) uniform.value = value;
}

function setUniform(material: { uniforms: Record<string, { value: unknown }> }, name: string, value: unknown): void {
  set(material.uniforms[name], value);
}
