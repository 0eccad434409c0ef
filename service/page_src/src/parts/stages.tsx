// What a run does: the line of stages, and the parts of stages that come in parts.

import { about, duration } from "../format";
import type { Stage } from "../types";
import { Bar } from "./basic";

interface Group {
  name: string;
  whole: Stage | null;
  parts: Stage[];
}

/** `name-1-0` as `name` and `1-0`. */
function cut(name: string): [string, string] {
  const match = /^(.+?)((?:[-/]\d+)+)$/.exec(name);
  return match === null ? [name, ""] : [match[1] ?? name, match[2]?.slice(1) ?? ""];
}

/** Stages in order; those that share a name but for numbers that count from 0 are parts of one. */
export function grouped(stages: Stage[]): Group[] {
  const counted = new Set<string>();
  for (const { name } of stages) {
    const [base, numbers] = cut(name);
    if (numbers.split(/[-/]/).includes("0")) counted.add(base);
  }
  const groups = new Map<string, Group>();
  for (const stage of stages) {
    const [base, numbers] = cut(stage.name);
    const part = numbers !== "" && counted.has(base);
    const name = part ? base : stage.name;
    const group = groups.get(name) ?? { name, whole: null, parts: [] };
    if (part) group.parts.push(stage);
    else group.whole = stage;
    groups.set(name, group);
  }
  return [...groups.values()];
}

export function stateOf(group: Group): string {
  const members = [...group.parts, ...(group.whole === null ? [] : [group.whole])];
  if (members.some((stage) => stage.state === "failed")) return "failed";
  if (members.some((stage) => stage.state === "stopped")) return "stopped";
  if (members.every((stage) => stage.state === "done")) return "done";
  return members.some((stage) => stage.state !== "waiting") ? "running" : "waiting";
}

export function Timeline({ stages }: { stages: Stage[] }) {
  const groups = grouped(stages);
  const longest = Math.max(1, ...groups.map(seconds));
  return (
    <ol class="timeline">
      {groups.map((group) => <Step key={group.name} group={group} longest={longest} />)}
    </ol>
  );
}

function seconds(group: Group): number {
  return [...group.parts, group.whole].reduce((sum, stage) => sum + (stage?.seconds ?? 0), 0);
}

function Step({ group, longest }: { group: Group; longest: number }) {
  const state = stateOf(group);
  const took = seconds(group);
  const members = [...group.parts, ...(group.whole === null ? [] : [group.whole])];
  const reused = members.length > 0 && members.every((stage) => stage.reused);
  return (
    <li class={`step step-${state}`} {...(state === "running" ? { "aria-current": "step" as const } : {})}>
      <span class="step-mark" aria-hidden="true">{{ done: "✓", failed: "!", stopped: "■", running: "", waiting: "" }[state]}</span>
      <div class="step-body">
        <div class="step-head">
          <span class="step-name">{group.name}</span>
          <span class="visually-hidden">{state}</span>
          {reused && <span class="tag">reused</span>}
          {state === "stopped" && <span class="quiet small" aria-hidden="true">stopped</span>}
          {group.parts.length > 0 && <span class="quiet small">{group.parts.filter((part) => part.state === "done").length} of {group.parts.length} parts</span>}
          <span class="quiet small step-time">{state === "done" || took > 0 ? duration(took) : ""}</span>
        </div>
        {state === "running" && <Now stage={members.find((stage) => stage.state === "running") ?? null} />}
        {state === "done" && !reused && <div class="step-length" style={{ width: `${String(Math.max(1, (100 * took) / longest))}%` }} />}
        {group.parts.length > 0 && <Parts parts={group.parts} />}
      </div>
    </li>
  );
}

function Now({ stage }: { stage: Stage | null }) {
  if (stage === null) return null;
  const known = stage.total !== null && stage.total > 0;
  return (
    <>
      <Bar fraction={known ? (stage.done ?? 0) / (stage.total ?? 1) : null} label={`Stage ${stage.name}`} />
      <span class="quiet small">
        {stage.what ?? ""}{known && ` ${String(stage.done ?? 0)} of ${String(stage.total)}`}{stage.eta_s !== null && `, ${about(stage.eta_s)} left`}
      </span>
    </>
  );
}

/** A cell for each part. */
function Parts({ parts }: { parts: Stage[] }) {
  return (
    <ul class="parts" aria-label="Parts">
      {parts.map((part) => {
        const number = cut(part.name)[1];
        const said = `Part ${number}: ${part.reused ? "reused" : part.state}${part.seconds === null ? "" : `, ${duration(part.seconds)}`}`;
        return <li key={part.name} class={`part part-${part.state}${part.reused ? " part-reused" : ""}`} title={said}><span aria-hidden="true">{number}</span><span class="visually-hidden">{said}</span></li>;
      })}
    </ul>
  );
}
