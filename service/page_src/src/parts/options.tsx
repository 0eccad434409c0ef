// A form made from the JSON Schema of the settings; only what differs from the defaults is sent.

import type { ComponentChildren } from "preact";
import { useMemo, useState } from "preact/hooks";

import { Problem, troubleOf } from "../api";
import type { Options, Schema } from "../types";

export type Changes = Record<string, unknown>;

interface Field {
  name: string;
  schema: Schema;
  fallback: unknown;
}

/** Every setting with its full name, in the order of the schema. */
export function fieldsOf(options: Options): Field[] {
  const fields: Field[] = [];
  const walk = (schema: Schema, defaults: unknown, above: string): void => {
    for (const [key, raw] of Object.entries(schema.properties ?? {})) {
      const child = resolved(raw, options.schema);
      const name = above === "" ? key : `${above}.${key}`;
      const fallback = (defaults as Record<string, unknown> | null | undefined)?.[key] ?? child.default ?? null;
      if (child.properties !== undefined) walk(child, fallback, name);
      else fields.push({ name, schema: { ...child, ...without(raw) }, fallback });
    }
  };
  walk(options.schema, options.defaults, "");
  return fields;
}

function without(schema: Schema): Schema {
  const rest = { ...schema };
  delete rest.$ref;
  return rest;
}

function resolved(schema: Schema, root: Schema): Schema {
  const name = schema.$ref?.split("/").pop();
  return name === undefined ? schema : (root.$defs?.[name] ?? schema);
}

/** The changes as the nested object that the server takes. */
export function nested(changes: Changes): Record<string, unknown> {
  const out: Record<string, unknown> = {};
  for (const [name, value] of Object.entries(changes)) {
    const parts = name.split(".");
    let at = out;
    for (const part of parts.slice(0, -1)) at = (at[part] ??= {}) as Record<string, unknown>;
    at[parts.at(-1) ?? ""] = value;
  }
  return out;
}

/** What a refusal says of single settings, to be shown beside them, and what is left to say elsewhere; group: where they are in a job. */
export function placed(error: unknown, options: Options | null, group: "config" | "import" = "config"): { errors: Record<string, string>; trouble: { cause: string; hint: string } } {
  const known = new Set(options === null ? [] : fieldsOf(options).map((field) => field.name));
  const refused = error instanceof Problem ? error.errors.map((one): [string, string] => [one.where.replace(new RegExp(`^(body\\.)?${group}\\.`), ""), one.message]) : [];
  if (refused.length === 0 || !refused.every(([name]) => known.has(name))) return { errors: {}, trouble: troubleOf(error) };
  const names = refused.map(([name]) => name).join(", ");
  return { errors: Object.fromEntries(refused), trouble: { cause: `Correct these settings: ${names}.`, hint: "The reason is beside each of them." } };
}

/** The other way round, for the settings of an earlier job. */
export function flat(config: unknown, fields: Field[]): Changes {
  const out: Changes = {};
  for (const { name } of fields) {
    const value = name.split(".").reduce<unknown>((at, part) => (at as Record<string, unknown> | null | undefined)?.[part], config);
    if (value !== undefined) out[name] = value;
  }
  return out;
}

export function OptionsForm(props: { options: Options; changes: Changes; set: (changes: Changes) => void; errors: Record<string, string>; kind?: "settings" | "import" }) {
  const { options, changes, set, errors, kind = "settings" } = props;
  const [query, setQuery] = useState("");
  const fields = useMemo(() => fieldsOf(options), [options]);
  const wanted = query.toLowerCase().split(/\s+/).filter((word) => word !== "");
  const matching = fields.filter(({ name, schema }) => {
    const text = `${name} ${schema.description ?? ""}`.toLowerCase();
    return name in errors || wanted.every((word) => text.includes(word));
  });
  const change = (name: string, value: unknown): void => {
    const next = { ...changes };
    if (value === undefined) Reflect.deleteProperty(next, name);
    else next[name] = value;
    set(next);
  };
  const groups = (members: Field[], label: string): ComponentChildren => [...grouped(members)].map(([group, inside]) => (
    <section key={group} class="group" aria-label={`${label}: ${group}`}>
      {kind === "settings" && <h3>{TITLES[group] ?? group}</h3>}
      {inside.map((field) => (
        <Row key={field.name} field={field} value={field.name in changes ? changes[field.name] : field.fallback}
          changed={field.name in changes} error={errors[field.name] ?? ""} change={change} kind={kind} />
      ))}
    </section>
  ));
  const basic = matching.filter((field) => field.schema.level !== "advanced");
  const advanced = matching.filter((field) => field.schema.level === "advanced");
  return (
    <div class="options">
      {kind === "settings" && <div class="toolbar">
        <input type="search" aria-label="Search settings" placeholder="Search settings, e.g. voxel" value={query} onInput={(event) => { setQuery(event.currentTarget.value); }} />
        <span class="quiet" role="status">{Object.keys(changes).length === 0 ? "All at their defaults" : `${String(Object.keys(changes).length)} changed`}</span>
      </div>}
      {groups(basic, kind === "settings" ? "Settings" : "Choices")}
      {advanced.length > 0 && (
        <details class="advanced" open={wanted.length > 0 || advanced.some((field) => field.name in changes || field.name in errors)}>
          <summary><span class="group-name">{kind === "settings" ? "Advanced settings" : "More choices"}</span><span class="quiet small">{advanced.length}</span></summary>
          {groups(advanced, kind === "settings" ? "Advanced settings" : "More choices")}
        </details>
      )}
      {matching.length === 0 && <p class="quiet">No setting matches.</p>}
    </div>
  );
}

const TITLES: Record<string, string> = { lidar: "LiDAR", gate: "Acceptance", split: "Parts of long recordings", merge: "Merging of parts", fusion: "Scans refined with the cameras" };

/** Fields by the group at the top of their name. */
function grouped(fields: Field[]): Map<string, Field[]> {
  const groups = new Map<string, Field[]>();
  for (const field of fields) {
    const group = field.name.includes(".") ? (field.name.split(".")[0] ?? "") : "general";
    groups.set(group, [...(groups.get(group) ?? []), field]);
  }
  return groups;
}

interface RowProps {
  field: Field;
  value: unknown;
  changed: boolean;
  error: string;
  change: (name: string, value: unknown) => void;
  kind: string;
}

function Row({ field, value, changed, error, change, kind }: RowProps) {
  const id = `${kind === "settings" ? "option" : kind}-${field.name.replaceAll(".", "-")}`;
  const [above, name] = labelOf(field.name, field.schema.unit ?? "");
  const plain = field.fallback !== "" && !(Array.isArray(field.fallback) && field.fallback.length === 0);
  const { meaning, unit = "", range = "", change_when: advice = "", description = "" } = field.schema;
  return (
    <div class={`option${changed ? " option-changed" : ""}`}>
      <label for={id}><span class="visually-hidden">{above} </span>{name}</label>
      <div class="option-input">
        <Input id={id} field={field} value={value} change={(next) => { change(field.name, next); }} />
        {unit !== "" && <span class="quiet small unit">{unit}</span>}
      </div>
      <div id={`${id}-help`} class="option-help small">
        <p><Prose text={meaning ?? description} /></p>
        {advice !== "" && <p class="quiet">Change it when: <Prose text={advice} /></p>}
        <p class="quiet">
          {range !== "" && <span>Range: {range}{unit === "" ? "" : ` ${unit}`}. </span>}{plain && <span>Default: {text(field.fallback)}</span>}
          {changed && <>{" "}<button type="button" class="link" aria-label={`Default for ${field.name}`} onClick={() => { change(field.name, undefined); }}>reset</button></>}
        </p>
      </div>
      {error !== "" && <p id={`${id}-error`} class="field-problem" role="alert">{error}</p>}
    </div>
  );
}

/** Text in which names of settings stand between backticks. */
function Prose({ text }: { text: string }) {
  return <>{text.split("`").map((part, at) => (at % 2 === 1 ? <code key={at}>{part}</code> : part))}</>;
}

const SUFFIXES: Record<string, string> = { m: "_m", s: "_s", GB: "_gb", px: "_px", degrees: "_deg" };

/** The group at the top, for screen readers only, and the rest of a setting's name without the unit. */
function labelOf(name: string, unit: string): [string, string] {
  const suffix = SUFFIXES[unit];
  const [group = "", ...rest] = (suffix !== undefined && name.endsWith(suffix) ? name.slice(0, -suffix.length) : name).split(".");
  const words = (parts: string[]): string => parts.join(" ").replaceAll("_", " ");
  return rest.length === 0 ? ["", words([group])] : [words([group]), words(rest)];
}

function text(value: unknown): string {
  if (value === "") return "(default)";
  return typeof value === "string" ? value : JSON.stringify(value);
}

function Input({ id, field, value, change }: { id: string; field: Field; value: unknown; change: (value: unknown) => void }) {
  const { schema } = field;
  const kinds = [schema, ...(schema.anyOf ?? [])];
  const described = { "aria-describedby": `${id}-help` };
  const choices = kinds.find((kind) => kind.enum !== undefined)?.enum;
  const is = (type: string): boolean => kinds.some((kind) => kind.type === type || (Array.isArray(kind.type) && kind.type.includes(type)));
  if (choices !== undefined) {
    return (
      <select id={id} {...described} value={JSON.stringify(value)} onChange={(event) => { change(JSON.parse(event.currentTarget.value)); }}>
        {choices.map((one) => <option key={JSON.stringify(one)} value={JSON.stringify(one)}>{text(one)}</option>)}
      </select>
    );
  }
  if (is("boolean")) {
    return <input id={id} type="checkbox" {...described} checked={value === true} onChange={(event) => { change(event.currentTarget.checked); }} />;
  }
  if (schema.items?.enum !== undefined) return <Several id={id} offered={schema.items.enum} value={Array.isArray(value) ? value : []} change={change} />;
  if (is("array") || is("object")) return <JsonInput id={id} value={value} change={change} />;
  if (is("number") || is("integer")) {
    const [nullable, whole] = [is("null"), !is("number")];
    return (
      <input
        id={id} type="number" step={whole ? 1 : "any"} {...described} value={value === null ? "" : String(value)}
        placeholder={nullable ? "none" : ""} min={schema.minimum} max={schema.maximum}
        onChange={(event) => {
          const typed = event.currentTarget.value;
          change(typed === "" ? (nullable ? null : undefined) : Number(typed));
        }}
      />
    );
  }
  return <input id={id} type="text" {...described} value={value === null ? "" : String(value)} onChange={(event) => { change(event.currentTarget.value); }} />;
}

/** Any of several. */
function Several({ id, offered, value, change }: { id: string; offered: unknown[]; value: unknown[]; change: (value: unknown) => void }) {
  if (offered.length === 0) return <span id={id} class="quiet small">None beside the bag: upload them with it.</span>;
  return (
    <div id={id} role="group" aria-describedby={`${id}-help`}>
      {offered.map((one) => (
        <label key={text(one)} class="check">
          <input type="checkbox" checked={value.includes(one)} onChange={(event) => { change(event.currentTarget.checked ? [...value, one] : value.filter((other) => other !== one)); }} /> {text(one)}
        </label>
      ))}
    </div>
  );
}

function JsonInput({ id, value, change }: { id: string; value: unknown; change: (value: unknown) => void }) {
  const [problem, setProblem] = useState("");
  return (
    <>
      <textarea
        id={id} rows={3} spellcheck={false} aria-describedby={`${id}-help`} aria-invalid={problem !== ""} defaultValue={JSON.stringify(value)}
        onChange={(event) => {
          try {
            change(JSON.parse(event.currentTarget.value));
            setProblem("");
          } catch {
            setProblem("This is not JSON.");
          }
        }}
      />
      {problem !== "" && <p class="field-problem" role="alert">{problem}</p>}
    </>
  );
}
