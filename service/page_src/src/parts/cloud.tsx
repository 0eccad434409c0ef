// The 3D view with its controls.

import { useEffect, useRef, useState } from "preact/hooks";

import { request } from "../api";
import { Octree } from "../cloud/octree";
import { CATEGORIES, type ColorBy, gradient, LABELS, LEGEND_FACTOR, UNITS } from "../cloud/palette";
import type { CloudFacts } from "../cloud/poses";
import { type Looks, type Status, Viewer } from "../cloud/viewer";
import { count } from "../format";
import { Segments } from "./basic";

interface Props {
  /** Address of a file of the cloud/ folder. */
  url: (name: string) => string;
  /** Whether there is a cloud.json with cameras and trajectories. */
  cameras: boolean;
  /** Expected error that most points stay below, m; null where it is not known. */
  most: number | null;
  chosen: number | null;
  choose: (image: number) => void;
  control: (viewer: Viewer | null) => void;
}

const FIRST: Looks = { colorBy: "rgb", rough: false, onlyColored: false, cameras: true, trajectories: true, size: 1, budget: 1_500_000 };
const ALL: ColorBy[] = ["rgb", "error", "height", "views", "spread", "part", "scan", "plane_error"];

export function CloudView({ url, cameras, most, chosen, choose, control }: Props) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const frame = useRef<HTMLDivElement>(null);
  const [viewer, setViewer] = useState<Viewer | null>(null);
  const [octree, setOctree] = useState<Octree | null>(null);
  const [looks, setLooks] = useState(FIRST);
  const [status, setStatus] = useState<Status>({ points: 0, loading: true });
  const [problem, setProblem] = useState("");
  const [pressed, setPressed] = useState<[number, number]>([0, 0]);
  useEffect(() => {
    let made: Viewer | null = null;
    let current = true;
    void open(url, cameras).then(
      ({ facts, tree }) => {
        if (!current || canvas.current === null) return;
        if (document.createElement("canvas").getContext("webgl2") === null) {
          setProblem("this browser has no WebGL 2, or it is switched off.");
          return;
        }
        made = new Viewer(canvas.current, tree, facts, FIRST, setStatus, most);
        setOctree(tree);
        setViewer(made);
        control(made);
      },
      (error: unknown) => { setProblem(error instanceof Error ? error.message : String(error)); },
    );
    return () => { current = false; made?.dispose(); control(null); };
  }, []);
  useEffect(() => { viewer?.setLooks(looks); }, [looks]);
  useEffect(() => { viewer?.choose(chosen); }, [viewer, chosen]);
  useEffect(() => { viewer?.setMostError(most); }, [viewer, most]);
  const set = (some: Partial<Looks>): void => { setLooks((old) => ({ ...old, ...some })); };
  if (problem !== "") return <div class="cloud cloud-problem"><p role="alert">The map cannot be shown: {problem}</p></div>;
  return (
    <div class="cloud" ref={frame}>
      <canvas
        ref={canvas} tabIndex={0} role="application" aria-label="Map in 3D" aria-describedby="cloud-help"
        onKeyDown={(event) => { if (viewer !== null && keys(viewer, event)) event.preventDefault(); }}
        onPointerDown={(event) => { setPressed([event.clientX, event.clientY]); }}
        onPointerMove={(event) => { if (event.buttons === 0) event.currentTarget.classList.toggle("over-camera", at(viewer, event) !== null); }}
        onClick={(event) => {
          const moved = Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
          const image = moved < 5 ? at(viewer, event) : null;
          if (image !== null) choose(image);
        }}
      />
      {viewer !== null && octree !== null && (
        <>
          <Panel looks={looks} set={set} viewer={viewer} octree={octree} />
          <div class="cloud-buttons">
            <button type="button" class="icon-button" title="Whole map (F)" aria-label="Whole map" onClick={() => { viewer.fit(); }}><Icon path="M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5M9 12h6M12 9v6" /></button>
            <button type="button" class="icon-button" title="Full screen" aria-label="Full screen" onClick={() => { void (document.fullscreenElement === null ? frame.current?.requestFullscreen() : document.exitFullscreen()); }}><Icon path="M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5" /></button>
          </div>
          <Legend by={looks.colorBy} viewer={viewer} octree={octree} />
        </>
      )}
      <p class="cloud-status small">
        {status.loading ? "Loading… " : ""}{count(status.points)} of {octree === null ? "–" : count(octree.metadata.points)} points
      </p>
      <p id="cloud-help" class="cloud-help small">Drag to turn, right-drag to move, scroll to zoom. Keys: arrows turn, + and − zoom, W A S D move, F shows all.</p>
    </div>
  );
}

function Icon({ path }: { path: string }) {
  return <svg class="icon" viewBox="0 0 24 24" aria-hidden="true"><path d={path} /></svg>;
}

async function open(url: (name: string) => string, cameras: boolean): Promise<{ facts: CloudFacts | null; tree: Octree }> {
  const tree = await Octree.open(url);
  const facts = cameras ? ((await (await request(url("cloud.json"))).json()) as CloudFacts) : null;
  tree.parts = facts?.parts ?? [];
  return { facts, tree };
}

function at(viewer: Viewer | null, event: MouseEvent): number | null {
  const box = (event.currentTarget as HTMLElement).getBoundingClientRect();
  return viewer?.cameraAt(event.clientX - box.left, event.clientY - box.top) ?? null;
}

function keys(viewer: Viewer, event: KeyboardEvent): boolean {
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  const acts: Record<string, () => void> = {
    ArrowLeft: () => { viewer.turn(-0.1, 0); }, ArrowRight: () => { viewer.turn(0.1, 0); },
    ArrowUp: () => { viewer.turn(0, -0.1); }, ArrowDown: () => { viewer.turn(0, 0.1); },
    "+": () => { viewer.turn(0, 0, 0.85); }, "=": () => { viewer.turn(0, 0, 0.85); }, "-": () => { viewer.turn(0, 0, 1.18); },
    a: () => { viewer.turn(0, 0, 1, -0.08); }, d: () => { viewer.turn(0, 0, 1, 0.08); },
    w: () => { viewer.turn(0, 0, 1, 0, 0.08); }, s: () => { viewer.turn(0, 0, 1, 0, -0.08); },
    f: () => { viewer.fit(); },
  };
  const act = acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  act?.();
  return act !== undefined;
}

function Panel({ looks, set, viewer, octree }: { looks: Looks; set: (some: Partial<Looks>) => void; viewer: Viewer; octree: Octree }) {
  const known = (by: ColorBy): boolean => octree.range(by) !== null && (by !== "error" || (octree.range(by)?.[1] ?? 0) > 0);
  const usable = ALL.filter((by) => by === "rgb" || by === "height" || known(by));
  return (
    <details class="cloud-panel" open={matchMedia("(min-width: 821px)").matches}>
      <summary>View</summary>
      {viewer.hasRough && (
        <Segments label="Poses" value={looks.rough ? "rough" : "refined"} options={[["rough", "Rough"], ["refined", "Refined"]]} choose={(value) => { set({ rough: value === "rough" }); }} />
      )}
      <label class="field">Color by
        <select value={looks.colorBy} onChange={(event) => { set({ colorBy: event.currentTarget.value as ColorBy }); }}>
          {usable.map((by) => <option key={by} value={by}>{LABELS[by]}</option>)}
        </select>
      </label>
      {looks.colorBy === "rgb" && octree.range("views") !== null && (
        <label class="check"><input type="checkbox" checked={looks.onlyColored} onChange={(event) => { set({ onlyColored: event.currentTarget.checked }); }} /> Only what images saw</label>
      )}
      <label class="check"><input type="checkbox" checked={looks.cameras} onChange={(event) => { set({ cameras: event.currentTarget.checked }); }} /> Cameras</label>
      <label class="check"><input type="checkbox" checked={looks.trajectories} onChange={(event) => { set({ trajectories: event.currentTarget.checked }); }} /> <span>Paths <span class="path-before">before</span>, <span class="path-after">after</span></span></label>
      <label class="field">Point size
        <input type="range" min={0.4} max={3} step={0.1} value={looks.size} onInput={(event) => { set({ size: Number(event.currentTarget.value) }); }} />
      </label>
      <label class="field">Detail
        <input
          type="range" min={5.3} max={7} step={0.05} value={Math.log10(looks.budget)} aria-valuetext={`${count(looks.budget)} points`}
          onInput={(event) => { set({ budget: Math.round(10 ** Number(event.currentTarget.value)) }); }}
        />
      </label>
    </details>
  );
}

function Legend({ by, viewer, octree }: { by: ColorBy; viewer: Viewer; octree: Octree }) {
  if (by === "rgb" || CATEGORIES.has(by)) return null;
  const factor = LEGEND_FACTOR[by] ?? 1;
  const shift = by === "height" ? octree.metadata.offset[2] : 0;
  const show = (value: number): string => value.toFixed(by === "height" ? 1 : by === "error" && value < 10 ? (value < 1 ? 2 : 1) : 0);
  const [low, most] = viewer.range(by).map((value) => show((value + shift) * factor));
  const high = by === "error" && viewer.range(by)[1] < (octree.range(by)?.[1] ?? 0) ? `≥ ${most ?? ""}` : most;
  return (
    <div class="cloud-legend" aria-label={`${LABELS[by]} from ${low ?? ""} to ${high ?? ""} ${UNITS[by]}`} role="img">
      <span class="small">{LABELS[by]}{by === "error" && " (gray: not known)"}</span>
      <span class="legend-bar" style={{ backgroundImage: gradient(by) }} />
      <span class="legend-ends small"><span>{low}</span><span>{high} {UNITS[by]}</span></span>
    </div>
  );
}
